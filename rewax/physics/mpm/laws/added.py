"""Stresses added to elastic stress: viscosity and muscles."""

import jax.numpy as jnp

from rewax import struct
from rewax.physics.mpm.laws.base import ActiveStress, Viscosity
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, Number, unit_vectors
from rewax.physics.numerics.components import Mat3
from rewax.types import Scalar, Vector


@struct.dataclass
class Newtonian(Viscosity):
    """Newtonian viscosity: tau = 2 J viscosity dev(sym C) for J = det F and the velocity gradient C. Gradient: exact.

    Attributes:
      viscosity: dynamic viscosity [Pa s], >= 0.
    """

    viscosity: Scalar = struct.number(NOT_NEGATIVE, "give the dynamic viscosity in Pa s")

    def stress(self, F: Mat3, velocity_gradient: Mat3) -> Mat3:
        C, J = velocity_gradient, cp.det(F)
        mean = (C[0][0] + C[1][1] + C[2][2]) * (1.0 / 3.0)
        return cp.matrix(lambda i, j: J * self.viscosity * (C[i][j] + C[j][i] - (2.0 * mean if i == j else 0.0)))

    def dynamic_viscosity(self) -> Scalar:
        return self.viscosity


@struct.dataclass
class Muscle(ActiveStress):
    """Active stress along the deformed fibres: tau = activation (F fibre) (F fibre)^T. Gradient: exact.

    Attributes:
      fibre: directions in the undeformed body, unit vectors of shape (3,) or (num_particles, 3).
      activation: active stress [Pa]; positive contracts.
    """

    fibre: Vector = struct.number(FINITE, "give unit vectors along the fibres", vector=True)
    activation: Scalar = struct.number(FINITE, "give an active stress in Pa")

    def numbers(self, prefix: str = "") -> list[Number]:
        return [*super().numbers(prefix), *unit_vectors(f"{prefix}fibre", self.fibre)]

    def stress(self, F: Mat3) -> Mat3:
        along = cp.matvec(F, cp.split_vector(jnp.asarray(self.fibre)))
        return cp.matrix(lambda i, j: self.activation * along[i] * along[j])
