"""Checks of colliders, of the ground and of the penalty law."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax.physics.contact.colliders import COLLIDER, Collider
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.numerics.checks import (
    FINITE,
    POSITIVE,
    Legal,
    Number,
    check_numbers,
    numbers_of,
    shown,
    unit_vectors,
)
from rewax.physics.numerics.fields import instance
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes.sizes import size_numbers

_LAW = instance(PenaltyContact, "give a PenaltyContact(stiffness=...)")
_GROUND = instance(Ground, "give a Ground(normal=...)")


def collider_numbers(colliders: tuple[Collider, ...], poses: Pose | None = None) -> list[Number]:
    """The numbers of colliders, and of their bodies' poses if given, with their legal values."""
    numbers = []
    for i, collider in enumerate(colliders):
        name = f"colliders[{i}]"
        COLLIDER(name, collider)
        numbers += [*size_numbers(collider.shape, f"{name}.shape"), *numbers_of(collider, f"{name}.")]
        numbers += _rotation_numbers(f"{name}.rotation", collider.rotation)
    if poses is not None and colliders:
        numbers += [
            Number("poses.position", poses.position, FINITE, "give positions in metres"),
            Number("poses.rotation", poses.rotation, FINITE, "give rotation matrices"),
            *_rotation_numbers("poses.rotation", poses.rotation),
        ]
    return numbers


def penalty_numbers(contact: PenaltyContact, name: str = "contact") -> list[Number]:
    """The numbers of a penalty law, with their legal values."""
    _LAW(name, contact)
    return numbers_of(contact, f"{name}.")


def ground_numbers(ground: Ground) -> list[Number]:
    """The numbers of the ground, with their legal values."""
    return [*numbers_of(ground, "ground."), *unit_vectors("ground.normal", ground.normal)]


def check_rotations(colliders: tuple[Collider, ...]) -> None:
    """Raises ValueError for a collider whose ``rotation`` is not a rotation matrix.

    Traced matrices are not checked here, nor are those of another shape or with numbers that are not finite.
    """
    for i, collider in enumerate(colliders):
        COLLIDER(f"colliders[{i}]", collider)
        matrix = np.zeros(0) if isinstance(collider.rotation, Tracer) else np.asarray(collider.rotation)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            continue
        if any(not np.all(number.legal.holds(number.value)) for number in _rotation_numbers("", matrix)):
            raise ValueError(
                f"colliders[{i}].rotation is {shown(matrix.tolist())}: give a rotation matrix, with orthonormal rows "
                "and determinant 1"
            )


def check_ground(ground: Any) -> None:
    """Raises ValueError for a ground without a unit normal, or with a number that is not finite."""
    _GROUND("ground", ground)
    check_numbers(numbers_of(ground, "ground."))
    if not isinstance(ground.normal, Tracer):
        length = float(np.linalg.norm(np.asarray(ground.normal)))
        if not abs(length - 1.0) < 1e-4:
            raise ValueError(f"ground.normal has length {length:g}: give a unit vector, (0, 1, 0) for y up")


def _rotation_numbers(name: str, matrix: Any) -> list[Number]:
    """How far matrices (..., 3, 3) are from orthonormal rows, and their determinants, with the values of rotations."""
    xp = jnp if isinstance(matrix, Tracer) else np
    rows = [xp.asarray(matrix)[..., i, :] for i in range(3)]
    products = xp.stack([xp.sum(rows[i] * rows[j], axis=-1) - (i == j) for i in range(3) for j in range(i + 1)])
    volume = xp.sum(xp.cross(rows[0], rows[1]) * rows[2], axis=-1)
    remedy = "give a rotation matrix"
    return [
        Number(f"the products of the rows of {name}", products, Legal(-1e-3, 1e-3), remedy),
        Number(f"the determinant of {name}", volume, POSITIVE, remedy),
    ]


__all__ = ["check_ground", "check_rotations", "collider_numbers", "ground_numbers", "penalty_numbers"]
