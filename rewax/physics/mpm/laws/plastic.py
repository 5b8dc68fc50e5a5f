"""Return maps: dough, sand, snow."""

import math

import jax.numpy as jnp

from rewax import struct
from rewax.physics.mpm.laws.base import Flow, LogarithmicPlasticity, Plasticity, Stretches, elongation_of
from rewax.physics.numerics import components as cp
from rewax.physics.numerics import divided_differences as dd
from rewax.physics.numerics.checks import NOT_NEGATIVE, POSITIVE, Legal
from rewax.physics.numerics.divided_differences import Principal
from rewax.physics.numerics.elastic_constants import LameParameters
from rewax.types import Array, Scalar

MAX_HARDENING = 5.0
"""Largest stiffness of packed snow over that of fresh snow [-]."""
_FRESH_SNOW = "for fresh snow give critical_compression 0.025, critical_stretch 0.0075 and hardening 10"


@struct.dataclass
class VonMises(LogarithmicPlasticity):
    """Dough: the deviator of logarithmic strain is limited to yield_stress / (2 mu); volume is conserved
    while no principal stretch is below ``least_stretch``.

    Attributes:
      yield_stress: Frobenius norm of the deviatoric Kirchhoff stress at yield [Pa], > 0: sqrt(2/3) times the von Mises
        stress, which is the yield stress in tension.

    Source: Gao et al. 2017, "An adaptive generalized interpolation material point method". Deviation: nothing is added
      to the norm of the deviatoric strain, so that the map is idempotent.
    """

    look = "dough"
    yield_stress: Scalar = struct.number(POSITIVE, "give the norm of the stress deviator at yield in Pa")

    def return_map(self, log_s: Principal, moduli: LameParameters) -> tuple[Principal, Array]:
        _, deviator, length = _deviator(log_s)
        return _shortening(deviator, length, self.yield_stress / (2.0 * moduli.shear))


@struct.dataclass
class DruckerPrager(LogarithmicPlasticity):
    """Sand: shear is limited in proportion to pressure, and separated particles carry no stress.

    The yield cone ends in its apex at the strain ``cohesion`` along each axis. Larger tensile strains return to the
    apex. Near the apex the direction of the deviator varies arbitrarily fast. The cone's radius is small there, so the
    derivative stays bounded. The derivative at the apex itself, as for F = I without cohesion, is that of compression.

    Attributes:
      friction_angle: friction angle of triaxial compression [rad], in (0, pi / 2).
      cohesion: largest tensile logarithmic strain along each axis [-], >= 0; not the stress of soil mechanics.

    Source: Klar et al. 2016, Drucker-Prager elastoplasticity, without the volume correction.
    """

    look = "sand"
    least_stretch = 0.05
    friction_angle: Scalar = struct.number(Legal(0.0, 0.5 * math.pi), "give an angle in radians (dry sand: 0.5)")
    cohesion: Scalar = struct.number(NOT_NEGATIVE, "give the largest tensile strain, 0 for none", default=0.0)

    def return_map(self, log_s: Principal, moduli: LameParameters) -> tuple[Principal, Array]:
        mu, lam = moduli
        mean, deviator, length = _deviator(log_s)
        sine = jnp.sin(self.friction_angle)
        slope = math.sqrt(2.0 / 3.0) * 2.0 * sine / (3.0 - sine)
        pulled = mean > self.cohesion
        compression = jnp.where(pulled, 0.0, 3.0 * (self.cohesion - mean))
        limit = (3.0 * lam + 2.0 * mu) / (2.0 * mu) * compression * slope
        shortening, flows = _shortening(deviator, length, limit)
        to_apex = dd.shift(dd.scale(-1.0, log_s), self.cohesion)
        return dd.select(pulled, to_apex, shortening), flows | pulled


@struct.dataclass
class Snow(Plasticity):
    """Snow: stretches are limited to 1 - critical_compression ... 1 + critical_stretch, and flow changes the moduli.

    The history variable is the plastic volume ratio J_p. Moduli are multiplied by exp(hardening (1 - J_p)), at most by
    ``MAX_HARDENING``. A particle that is turned inside out in any substep has J_p = 0 from then on, which sets
    ``Status.INVERTED``.

    Attributes:
      critical_compression: [-], between 0 and 1 (fresh: 0.025).
      critical_stretch: [-], > 0 (fresh: 0.0075).
      hardening: [-], > 0 (fresh: 10).

    Source: Stomakhin et al. 2013, "A material point method for snow simulation".
    """

    look = "snow"
    initial_memory = (1.0,)
    largest_stiffness = MAX_HARDENING
    critical_compression: Scalar = struct.number(Legal(0.0, 1.0), _FRESH_SNOW)
    critical_stretch: Scalar = struct.number(POSITIVE, _FRESH_SNOW)
    hardening: Scalar = struct.number(POSITIVE, _FRESH_SNOW)

    def flow(self, s: Stretches, moduli: LameParameters, memory: tuple[Array, ...]) -> Flow:
        del moduli
        low, high = 1.0 - self.critical_compression, 1.0 + self.critical_stretch
        new = Stretches.of(dd.minimum(dd.maximum(s.values, low), high))
        # Clamping makes the volume positive again: without the maximum J_p would stay negative, and nobody would know.
        plastic_volume = memory[0] * jnp.maximum(s.volume, 0.0) / new.volume
        return Flow(new, elongation_of(s.values, new.values), (plastic_volume,))

    def stiffness(self, memory: tuple[Array, ...]) -> Array:
        return jnp.exp(jnp.minimum(self.hardening * (1.0 - memory[0]), math.log(MAX_HARDENING)))

    def was_inverted(self, memory: tuple[Array, ...]) -> Array:
        return memory[0] <= 0.0


def _deviator(log_s: Principal) -> tuple[Array, Principal, Array]:
    """Mean of logarithmic strains, their deviator and its norm."""
    mean = log_s.sum * (1.0 / 3.0)
    deviator = dd.shift(log_s, -mean)
    return mean, deviator, cp.norm(deviator.values)


def _shortening(deviator: Principal, length: Array, limit: Scalar) -> tuple[Principal, Array]:
    """Change that shortens the deviator to the limit, and whether it is longer."""
    flows = length > limit
    return dd.scale(jnp.where(flows, limit / jnp.where(flows, length, 1.0) - 1.0, 0.0), deviator), flows
