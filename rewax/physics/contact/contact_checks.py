"""Checks of colliders, of the ground and of the penalty law."""

from typing import Any

import numpy as np
from jax.core import Tracer

from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.numerics.checks import FINITE, Number, check_numbers, numbers_of
from rewax.physics.numerics.fields import instance, items
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes.sizes import size_numbers

_COLLIDER = instance(Collider, "give a Collider(shape=..., friction=...)")
_LAW = instance(PenaltyContact, "give a PenaltyContact(stiffness=...)")
_GROUND = instance(Ground, "give a Ground(normal=...)")
COLLIDERS = items(_COLLIDER, "give a tuple of colliders, () for none")
"""Rule for the colliders of a scene."""


def collider_numbers(colliders: tuple[Collider, ...], poses: Pose | None = None) -> list[Number]:
    """The numbers of colliders, and of their bodies' poses if given, with their legal values."""
    numbers = []
    for i, collider in enumerate(colliders):
        name = f"colliders[{i}]"
        _COLLIDER(name, collider)
        numbers += [*size_numbers(collider.shape, f"{name}.shape"), *numbers_of(collider, f"{name}.")]
    if poses is not None and colliders:
        numbers += [
            Number("poses.position", poses.position, FINITE, "give positions in metres"),
            Number("poses.rotation", poses.rotation, FINITE, "give rotation matrices"),
        ]
    return numbers


def penalty_numbers(contact: PenaltyContact, name: str = "contact") -> list[Number]:
    """The numbers of a penalty law, with their legal values."""
    _LAW(name, contact)
    return numbers_of(contact, f"{name}.")


def ground_numbers(ground: Ground) -> list[Number]:
    """The numbers of the ground, with their legal values."""
    return numbers_of(ground, "ground.")


def check_ground(ground: Any) -> None:
    """Raises ValueError for a ground without a unit normal, or with a number that is not finite."""
    _GROUND("ground", ground)
    check_numbers(ground_numbers(ground))
    if not isinstance(ground.normal, Tracer):
        length = float(np.linalg.norm(np.asarray(ground.normal)))
        if not abs(length - 1.0) < 1e-4:
            raise ValueError(f"ground.normal has length {length:g}: give a unit vector, (0, 1, 0) for y up")


__all__ = ["COLLIDERS", "check_ground", "collider_numbers", "ground_numbers", "penalty_numbers"]
