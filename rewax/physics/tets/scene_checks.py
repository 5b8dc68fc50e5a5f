"""Checks of the parts of a scene of tetrahedra."""

from typing import Any

import numpy as np
from jax.core import Tracer

from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, POSITIVE, Number


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


__all__ = ["check_moduli", "material_numbers"]
