"""What the numbers of colliders, of the ground and of the penalty law may be."""

from typing import Any

import numpy as np
from jax.core import Tracer

from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, POSITIVE, Number, check_numbers
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes.sizes import size_numbers

_FRICTION = "give a Coulomb coefficient, 0 for none"


def collider_numbers(colliders: tuple[Collider, ...], poses: Pose | None = None) -> list[Number]:
    """The numbers of colliders, and of their bodies' poses if these are given."""
    numbers = []
    for i, collider in enumerate(colliders):
        name = f"colliders[{i}]"
        if not isinstance(collider, Collider):
            raise ValueError(f"{name} is {collider!r}: give a Collider(shape=..., friction=...)")
        numbers += [
            *size_numbers(collider.shape, f"{name}.shape"),
            Number(f"{name}.offset", collider.offset, FINITE, "give a position in metres", (3,)),
            Number(f"{name}.rotation", collider.rotation, FINITE, "give a rotation matrix", (3, 3)),
            Number(f"{name}.friction", collider.friction, NOT_NEGATIVE, _FRICTION),
        ]
        if collider.softness is not None:
            remedy = "give a decay per metre, or None for a reach of one cell"
            numbers.append(Number(f"{name}.softness", collider.softness, POSITIVE, remedy))
    if poses is not None and colliders:
        numbers += [
            Number("poses.position", poses.position, FINITE, "give positions in metres"),
            Number("poses.rotation", poses.rotation, FINITE, "give rotation matrices"),
        ]
    return numbers


def penalty_numbers(contact: PenaltyContact, name: str = "contact") -> list[Number]:
    """The numbers of a penalty law."""
    if not isinstance(contact, PenaltyContact):
        raise ValueError(f"{name} is {contact!r}: give a PenaltyContact(stiffness=...)")
    units = {
        "damping": "N s/m", "friction_damping": "N s/m", "radius": "m", "onset": "m", "depth_damping": "N s/m^2",
    }  # fmt: skip
    return [
        Number(f"{name}.stiffness", contact.stiffness, POSITIVE, "give a force per penetration in N/m"),
        Number(f"{name}.friction", contact.friction, NOT_NEGATIVE, _FRICTION),
        *(Number(f"{name}.{f}", getattr(contact, f), NOT_NEGATIVE, f"give a number of {u}") for f, u in units.items()),
    ]


def ground_numbers(ground: Ground) -> list[Number]:
    """The numbers of the ground."""
    return [
        Number("ground.normal", ground.normal, FINITE, "give a unit vector, (0, 1, 0) for y up"),
        Number("ground.height", ground.height, FINITE, "give a distance in metres"),
    ]


def check_ground(ground: Any) -> None:
    """Raises ValueError for a ground without a unit normal, or with a number that is not finite."""
    if not isinstance(ground, Ground):
        raise ValueError(f"ground is {ground!r}: give a Ground(normal=...)")
    check_numbers(ground_numbers(ground))
    if not isinstance(ground.normal, Tracer):
        length = float(np.linalg.norm(np.asarray(ground.normal)))
        if not abs(length - 1.0) < 1e-4:
            raise ValueError(f"ground.normal has length {length:g}: give a unit vector, (0, 1, 0) for y up")


__all__ = ["check_ground", "collider_numbers", "ground_numbers", "penalty_numbers"]
