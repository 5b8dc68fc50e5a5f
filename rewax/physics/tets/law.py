"""The constitutive law of tetrahedra: stable neo-Hookean elasticity, activation and damping, by components."""

import enum
from typing import NamedTuple

import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import POSITIVE, Legal
from rewax.physics.numerics.components import Mat3
from rewax.physics.numerics.elastic_constants import lame_parameters
from rewax.physics.numerics.fields import checked, real
from rewax.types import Array, Scalar


class DampingLaw(enum.Enum):
    """The rate that is damped, in addition to the change of volume."""

    VELOCITY_GRADIENT = "velocity gradient"
    """dF/dt, as in NVIDIA Warp. It damps rigid rotation too: torque = 2 damping volume angular velocity."""
    STRAIN_RATE = "strain rate"
    """The rate of the Green strain. Rigid motion is undamped, and angular momentum is conserved."""


class StableParameters(NamedTuple):
    """Parameters of the stable neo-Hookean law [Pa]. They are not Lame's: see ``stable_parameters``."""

    mu: Scalar
    lam: Scalar


class SmallStrainModuli(NamedTuple):
    """Moduli of the law at small strains."""

    youngs_modulus: Scalar
    """Young's modulus [Pa]."""
    poissons_ratio: Scalar
    """Poisson's ratio [-]."""


@checked(
    youngs_modulus=real(POSITIVE, "give Young's modulus in Pa"),
    poissons_ratio=real(Legal(-1.0, 0.5), "take 0.45 for rubber (0.5 is incompressible)"),
)
def stable_parameters(youngs_modulus: Scalar, poissons_ratio: Scalar) -> StableParameters:
    """Parameters with which the law has a given Young's modulus and Poisson's ratio at small strains.

    With Lame's parameters m and l of the linear material: mu = 4/3 m, lam = l + 5/6 m.

    Args:
      youngs_modulus: [Pa], > 0.
      poissons_ratio: [-], in (-1, 0.5).

    Gradient: exact. Source: Smith et al. 2018, "Stable neo-Hookean flesh simulation", section 3.4.
    """
    m, l = lame_parameters(youngs_modulus, poissons_ratio)  # noqa: E741
    return StableParameters(4.0 / 3.0 * m, l + 5.0 / 6.0 * m)


@checked(
    mu=real(POSITIVE, "give the law's shear parameter in Pa"),
    lam=real(POSITIVE, "give the law's volume parameter in Pa"),
)
def small_strain_moduli(mu: Scalar, lam: Scalar) -> SmallStrainModuli:
    """Young's modulus and Poisson's ratio of the law at small strains; inverse of ``stable_parameters``.

    The stress of F = I + H is 3/4 mu (H + H^T) + (lam - 5/8 mu) tr(H) I to first order, so Lame's parameters are
    3/4 mu and lam - 5/8 mu. The bulk modulus is lam - mu/8, so stability needs lam > mu/8. Rewarped's mu = lam =
    1000 Pa correspond to E = 1750 Pa, nu = 1/6.

    Gradient: exact.
    """
    m, l = 0.75 * mu, lam - 0.625 * mu  # noqa: E741
    return SmallStrainModuli(m * (3.0 * l + 2.0 * m) / (l + m), l / (2.0 * (l + m)))


def energy_density(F: Mat3, mu: Scalar, lam: Scalar, activation: Scalar = 0.0) -> Array:
    """Elastic energy per rest volume [J/m^3].

    With I = |F|^2, J = det F, a the activation and e = J - 1 + a:
    psi = mu/2 (I - 3) - mu/2 log((I + 1) / 4) + lam/2 e^2 - 3/4 mu e. It is zero at rest without activation. Activation
    changes the volume at rest, so the energy can be negative.

    Args:
      F: deformation gradient [-], components of any shape.
      mu, lam: parameters [Pa], broadcast against the components.
      activation: [-]; positive contracts.

    Gradient: exact, finite for every F, also flattened and inverted ones.
    Source: Smith et al. 2018, eq. 14, shifted by a constant; activation as in NVIDIA Warp's soft meshes.
    """
    square = sum(cp.dot(row, row) for row in F)
    e = cp.det(F) - 1.0 + activation
    return 0.5 * mu * (square - 3.0 - jnp.log(0.25 * (square + 1.0))) + 0.5 * lam * e * e - 0.75 * mu * e


def first_piola_stress(
    F: Mat3,
    rate: Mat3 | None,
    *,
    mu: Scalar,
    lam: Scalar,
    activation: Scalar = 0.0,
    damping: Scalar = 0.0,
    damping_law: DampingLaw = DampingLaw.VELOCITY_GRADIENT,
) -> Mat3:
    """First Piola-Kirchhoff stress [Pa], by components.

    P = mu (1 - 1/(I + 1)) F + (lam (J - 1 + a) - 3/4 mu + k dJ/dt) dJ/dF + k D. Here k is the damping, and D is dF/dt
    or F times the rate of the Green strain, depending on ``damping_law``.

    Args:
      F: deformation gradient [-].
      rate: dF/dt [1/s]; None: no damping.
      mu, lam: parameters [Pa].
      activation: [-], see ``energy_density``.
      damping: viscosity [Pa s].
      damping_law: the damped rate.

    Gradient: exact, finite for every F.
    Source: Smith et al. 2018, eq. 18; damping as in NVIDIA Warp's soft meshes. Deviation: the volume rate is dJ/dt.
      Warp uses three vertices' velocities relative to a fixed origin, where pure translation causes a force.
    """
    square = sum(cp.dot(row, row) for row in F)
    cofactor = materialize(cp.cofactor(F))
    volume_ratio = cp.dot(F[0], cofactor[0])
    deviatoric = mu * (1.0 - 1.0 / (square + 1.0))
    pressure = lam * (volume_ratio - 1.0 + activation) - 0.75 * mu
    if rate is None:
        return cp.matrix(lambda i, j: deviatoric * F[i][j] + pressure * cofactor[i][j])
    volume_rate = materialize(sum(cp.dot(c, r) for c, r in zip(cofactor, rate, strict=True)))
    deviatoric, pressure = materialize((deviatoric, pressure + damping * volume_rate))
    damped = rate
    if damping_law is DampingLaw.STRAIN_RATE:
        product = cp.matmul(cp.transpose(F), rate)
        damped = cp.matmul(F, cp.matrix(lambda i, j: 0.5 * (product[i][j] + product[j][i])))
    return cp.matrix(lambda i, j: deviatoric * F[i][j] + pressure * cofactor[i][j] + damping * damped[i][j])


def wave_modulus(mu: Scalar, lam: Scalar) -> Scalar:
    """Modulus of pressure waves at rest [Pa]: lam + 7/8 mu; density times the squared speed of sound."""
    return lam + 0.875 * mu


__all__ = [
    "DampingLaw",
    "SmallStrainModuli",
    "StableParameters",
    "energy_density",
    "first_piola_stress",
    "small_strain_moduli",
    "stable_parameters",
    "wave_modulus",
]
