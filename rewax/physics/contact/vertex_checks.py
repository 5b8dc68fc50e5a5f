"""Checks that scenes of vertices share: tetrahedra, cloth and ropes."""

from typing import Any

import numpy as np
from jax.core import Tracer

from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.contact_checks import collider_numbers, ground_numbers, penalty_numbers
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.numerics.checks import FINITE, GRAVITY, Number, friction_dampings
from rewax.physics.numerics.fields import check_range
from rewax.physics.numerics.pose import Pose
from rewax.types import Scalar


def contact_numbers(
    contact: PenaltyContact | None, ground: Ground | None, colliders: tuple[Collider, ...], poses: Pose | None = None
) -> list[Number]:
    """The numbers of contact law, ground and colliders, with their legal values."""
    numbers = [] if contact is None else penalty_numbers(contact)
    numbers += [*([] if ground is None else ground_numbers(ground)), *collider_numbers(colliders, poses)]
    if contact is None:
        return numbers
    frictions = [*([] if ground is None else [contact.friction]), *(collider.friction for collider in colliders)]
    return [*numbers, *friction_dampings("contact.friction_damping", contact.friction_damping, *frictions)]


def gravity_number(gravity: Any) -> Number:
    """Gravity [m/s^2], with its legal values."""
    return Number("gravity", gravity, FINITE, GRAVITY, (3,))


def check_vectors(num_vertices: int, **vectors: Any) -> None:
    """Raises ValueError for arrays over vertices that belong to another mesh or to a batch of states."""
    want = (num_vertices, 3)
    for name, value in vectors.items():
        if np.shape(value) != want:
            raise ValueError(
                f"{name} has shape {np.shape(value)}, but the scene has {num_vertices} vertices: give shape {want} "
                "(map batches with jax.vmap)"
            )


def check_length(number: Number, length: int) -> None:
    """Raises ValueError for values that are neither one number nor one for each of ``length`` elements."""
    shape = np.shape(number.value)
    if shape not in ((), (length,)):
        raise ValueError(f"{number.name} has shape {shape}: give a number or an array of shape ({length},)")


def check_has_law(contact: PenaltyContact | None, ground: Ground | None, colliders: tuple[Collider, ...]) -> None:
    """Raises ValueError for ground or colliders without a contact law."""
    if contact is None and (ground is not None or colliders):
        raise ValueError(
            "contact is None, but the scene has a ground or colliders: give a PenaltyContact(stiffness=...)"
        )


def check_dt(dt: float, limit: Scalar) -> None:
    """Raises ValueError for a substep [s] above the largest stable one. A traced limit is not checked."""
    if not isinstance(limit, Tracer) and dt > float(limit):
        raise ValueError(
            f"dt is {dt:g} s, above the largest stable {float(limit):.3g} s of this mesh, material and contact: take "
            "more substeps of smaller dt, softer or denser material, softer contact, or a coarser mesh"
        )


def held_indices(held: Any, num_vertices: int, name: str = "held") -> np.ndarray:
    """Indices of held vertices, in the order given, from indices or a mask. Messages have the name."""
    try:
        held = np.asarray(held)
    except ValueError:  # rows of several lengths
        held = np.asarray(None)
    if held.size == 0:
        return np.zeros(0, int)
    if held.dtype == bool and held.shape == (num_vertices,):
        return np.flatnonzero(held)
    if held.ndim > 1 or not np.issubdtype(held.dtype, np.integer) or len(np.unique(held)) < held.size:
        raise ValueError(
            f"{name} is an array of {held.dtype} of shape {held.shape}: give different indices of vertices, or a mask "
            f"of shape ({num_vertices},)"
        )
    held = held.reshape(-1)
    check_range(name, held, num_vertices)
    return held


__all__ = [
    "check_dt", "check_has_law", "check_length", "check_vectors", "contact_numbers", "gravity_number", "held_indices",
]  # fmt: skip
