"""Fluids: pressure as a function of volume."""

import jax.numpy as jnp

from rewax import struct
from rewax.physics.mpm.laws.base import Fluid
from rewax.physics.numerics.checks import POSITIVE, Legal
from rewax.physics.numerics.elastic_constants import lame_parameters
from rewax.types import Array, Scalar

MIN_FLUID_VOLUME = 0.05
"""Lower bound of a fluid's volume ratio J [-]."""
TAIT_EXPONENT = 7.0
"""Exponent of Tait's equation of state for water [-]."""


@struct.dataclass
class QuadraticFluid(Fluid):
    """Water as in Rewarped: tau = lambda J (J - 1), a solid's pressure without shear. Gradient: exact.

    Attributes:
      youngs_modulus: E [Pa], > 0.
      poissons_ratio: nu [-], in (0, 0.5); E and nu give lambda, the bulk modulus.
    """

    youngs_modulus: Scalar = struct.number(POSITIVE, "give Young's modulus in Pa")
    poissons_ratio: Scalar = struct.number(Legal(0.0, 0.5), "take 0.3, say (at 0 the fluid has no pressure)")

    def stress(self, J: Array, density: Scalar) -> Array:
        del density
        return self._bulk_modulus() * J * (J - 1.0)

    def energy_of_volume(self, J: Array, density: Scalar) -> Array:
        del density
        return 0.5 * self._bulk_modulus() * (J - 1.0) ** 2

    def sound_speed(self, density: Scalar) -> Scalar:
        return jnp.sqrt(self._bulk_modulus() / density)

    def _bulk_modulus(self) -> Scalar:
        return lame_parameters(self.youngs_modulus, self.poissons_ratio).first


@struct.dataclass
class Tait(Fluid):
    """Weakly compressible water: tau = -J p with p = density c^2 / 7 (J^-7 - 1).

    Attributes:
      speed_of_sound: c at rest [m/s], > 0.

    Gradient: exact.
    Source: Becker and Teschner 2007, "Weakly compressible SPH for free surface flows".
    """

    speed_of_sound: Scalar = struct.number(POSITIVE, "give the fluid's speed of sound in m/s")

    def stress(self, J: Array, density: Scalar) -> Array:
        return (density * self.speed_of_sound**2 / TAIT_EXPONENT) * (J - J ** (1.0 - TAIT_EXPONENT))

    def energy_of_volume(self, J: Array, density: Scalar) -> Array:
        n = TAIT_EXPONENT
        return (density * self.speed_of_sound**2 / n) * (J + (J ** (1.0 - n) - n) / (n - 1.0))

    def sound_speed(self, density: Scalar) -> Scalar:
        del density
        return self.speed_of_sound
