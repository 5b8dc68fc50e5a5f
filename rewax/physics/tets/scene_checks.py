"""Checks of the parts of a scene of tetrahedra."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.contact_checks import collider_numbers, ground_numbers, penalty_numbers
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.numerics.checks import FINITE, GRAVITY, NOT_NEGATIVE, POSITIVE, Number
from rewax.physics.numerics.pose import Pose


def material_numbers(mu: Any, lam: Any, damping: Any, activation: Any) -> list[Number]:
    """The parameters of the material, with their legal values."""
    moduli = "take it from tets.law.stable_parameters(youngs_modulus, poissons_ratio)"
    damped = [] if damping is None else [Number("damping", damping, NOT_NEGATIVE, "give a viscosity in Pa s")]
    return [
        Number("mu", mu, POSITIVE, f"give the law's shear parameter in Pa, {moduli}"),
        Number("lam", lam, POSITIVE, f"give the law's volume parameter in Pa, {moduli}"),
        *damped,
        Number("activation", activation, FINITE, "give a change of volume ratio, or one per tet"),
    ]


def contact_numbers(
    contact: PenaltyContact | None, ground: Ground | None, colliders: tuple[Collider, ...], poses: Pose | None = None
) -> list[Number]:
    """The numbers of contact law, ground and colliders, with their legal values."""
    numbers = [] if contact is None else penalty_numbers(contact)
    return [*numbers, *([] if ground is None else ground_numbers(ground)), *collider_numbers(colliders, poses)]


def gravity_number(gravity: Any) -> Number:
    return Number("gravity", gravity, FINITE, GRAVITY, (3,))


def check_length(number: Number, length: int) -> None:
    shape = jnp.shape(number.value)
    if shape not in ((), (length,)):
        raise ValueError(f"{number.name} has shape {shape}: give a number or an array of shape ({length},)")


def held_indices(held: Any, num_vertices: int) -> np.ndarray:
    try:
        held = np.asarray(held)
    except ValueError:  # rows of several lengths
        held = np.asarray(None)
    if held.size == 0:
        return np.zeros(0, int)
    if held.dtype == bool and held.shape == (num_vertices,):
        return np.flatnonzero(held)
    if held.ndim > 1 or not np.issubdtype(held.dtype, np.integer):
        raise ValueError(
            f"held is an array of {held.dtype} of shape {held.shape}: give indices of vertices, or a mask of shape "
            f"({num_vertices},)"
        )
    return held


def check_moduli(mu: Any, lam: Any) -> None:
    if isinstance(mu, Tracer) or isinstance(lam, Tracer):
        return
    mu, lam = np.broadcast_arrays(mu, lam)
    if not np.all(lam > mu / 8):
        worst = np.argmin(lam - mu / 8)
        raise ValueError(
            f"lam is {lam.flat[worst]:g} with mu {mu.flat[worst]:g}, but must be above mu / 8, where the bulk modulus "
            "is 0: take both from tets.stable_parameters(youngs_modulus, poissons_ratio)"
        )


__all__ = ["check_length", "check_moduli", "contact_numbers", "gravity_number", "held_indices", "material_numbers"]
