"""Constitutive laws as objects; ``docs/your_own_law.md`` adds one."""

from rewax.physics.mpm.laws.added import Muscle, Newtonian
from rewax.physics.mpm.laws.base import (
    ActiveStress,
    Elasticity,
    Flow,
    Fluid,
    LogarithmicPlasticity,
    Plasticity,
    Stretches,
    Viscosity,
    elongation_of,
)
from rewax.physics.mpm.laws.elastic import FixedCorotated, Hencky, NeoHookean, TwoModuli
from rewax.physics.mpm.laws.fluids import TAIT_EXPONENT, QuadraticFluid, Tait
from rewax.physics.mpm.laws.plastic import MAX_HARDENING, DruckerPrager, Snow, VonMises
from rewax.physics.numerics.divided_differences import Principal
from rewax.physics.numerics.elastic_constants import LameParameters

__all__ = [
    "MAX_HARDENING", "TAIT_EXPONENT", "ActiveStress", "DruckerPrager", "Elasticity", "FixedCorotated", "Flow", "Fluid",
    "Hencky", "LameParameters", "LogarithmicPlasticity", "Muscle", "NeoHookean", "Newtonian", "Plasticity",
    "Principal", "QuadraticFluid", "Snow", "Stretches", "Tait", "TwoModuli", "Viscosity", "VonMises", "elongation_of",
]  # fmt: skip
