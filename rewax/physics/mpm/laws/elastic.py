"""Elastic laws of solids with two moduli. mu and lambda are the Lame parameters."""

from rewax import struct
from rewax.physics.mpm.laws.base import Elasticity, Stretches
from rewax.physics.numerics import components as cp
from rewax.physics.numerics import divided_differences as dd
from rewax.physics.numerics.checks import POSITIVE, Legal
from rewax.physics.numerics.divided_differences import Principal
from rewax.physics.numerics.elastic_constants import LameParameters, lame_parameters
from rewax.types import Array, Scalar


@struct.dataclass
class TwoModuli(Elasticity):
    """Base of laws with Young's modulus and Poisson's ratio.

    Attributes:
      youngs_modulus: E [Pa], > 0.
      poissons_ratio: nu [-], in (-1, 0.5).
    """

    youngs_modulus: Scalar = struct.number(POSITIVE, "give Young's modulus in Pa")
    poissons_ratio: Scalar = struct.number(Legal(-1.0, 0.5), "take 0.45 for rubber (0.5 is incompressible)")

    def moduli(self) -> LameParameters:
        return lame_parameters(self.youngs_modulus, self.poissons_ratio)


@struct.dataclass
class Hencky(TwoModuli):
    """tau_i = 2 mu log s_i + lambda sum_k log s_k for principal stretches s_i: quadratic in logarithmic strain.

    Gradient: exact with respect to F and both moduli, also for equal stretches.
    Source: Klar et al. 2016, Drucker-Prager elastoplasticity, section 6.
    """

    def principal_stress(self, s: Stretches) -> Principal:
        mu, lam = self.moduli()
        return dd.shift(dd.scale(2.0 * mu, s.log), lam * s.log.sum)

    def energy(self, s: Stretches) -> Array:
        mu, lam = self.moduli()
        return mu * cp.dot(s.log.values, s.log.values) + 0.5 * lam * s.log.sum**2


@struct.dataclass
class FixedCorotated(TwoModuli):
    """tau_i = 2 mu (s_i - 1) s_i + lambda (J - 1) J for principal stretches s_i, J = det F.

    Its energy is finite through inversion.

    Gradient: exact with respect to F and both moduli, also for equal stretches.
    Source: Stomakhin et al. 2012, "Energetically consistent invertible elasticity".
    """

    def principal_stress(self, s: Stretches) -> Principal:
        (mu, lam), J = self.moduli(), s.volume
        return dd.shift(dd.scale(2.0 * mu, dd.multiply(dd.shift(s.values, -1.0), s.values)), lam * (J - 1.0) * J)

    def energy(self, s: Stretches) -> Array:
        mu, lam = self.moduli()
        return mu * sum((a - 1.0) ** 2 for a in s.values.values) + 0.5 * lam * (s.volume - 1.0) ** 2


@struct.dataclass
class NeoHookean(TwoModuli):
    """tau_i = mu (s_i^2 - 1) + lambda log J for principal stretches s_i, J = det F.

    Gradient: exact with respect to F and both moduli, also for equal stretches.
    Source: Jiang et al. 2016, MPM course notes, eq. 48, times F^T.
    """

    def principal_stress(self, s: Stretches) -> Principal:
        mu, lam = self.moduli()
        return dd.shift(dd.scale(mu, dd.shift(dd.multiply(s.values, s.values), -1.0)), lam * s.log.sum)

    def energy(self, s: Stretches) -> Array:
        (mu, lam), trace = self.moduli(), s.log.sum
        square = cp.dot(s.values.values, s.values.values)
        return 0.5 * mu * (square - 3.0) - mu * trace + 0.5 * lam * trace**2
