"""Elasticity and plasticity of isotropic solids, composed freely.

Every law here needs only the left Cauchy-Green tensor b = F F^T = U diag(s^2) U^T: an elastic law maps principal
stretches s to principal Kirchhoff stresses tau, a return map maps trial stretches to admissible ones. So any
elasticity goes with any plasticity, and both share one spectral evaluation whose derivative is exact (``linalg3``).

Kirchhoff stress tau = J sigma. Stretches of an inverted particle (det F < 0) carry a minus sign on the smallest one.
"""

import enum
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.physics import components as cp
from rewax.physics.components import Mat3, Vec3
from rewax.physics.linalg3 import spectral
from rewax.physics.materialize import materialize
from rewax.types import Array, Scalar

MIN_STRETCH = 1e-5
"""Stretches below this count as this in logarithms and quotients [-]."""
MIN_PLASTIC_STRETCH = 0.01
"""Trial stretches below this count as this in the von Mises return map [-]."""


class Elasticity(enum.Enum):
    """How stretches make stress."""

    HENCKY = "hencky"
    """tau = 2 mu log s + lambda tr(log s): quadratic in logarithmic strain."""
    FIXED_COROTATED = "fixed_corotated"
    """tau = 2 mu (s - 1) s + lambda (J - 1) J."""
    NEO_HOOKEAN = "neo_hookean"
    """tau = mu (s^2 - 1) + lambda log J."""


class Plasticity(enum.Enum):
    """What happens to stretches beyond the yield surface."""

    NONE = "none"
    VON_MISES = "von_mises"
    """The deviator of logarithmic strain is limited to yield_stress / (2 mu), volume is kept."""


@struct.dataclass
class Material(struct.Replaceable):
    """An isotropic elastic or elastoplastic solid.

    Attributes:
      youngs_modulus: Young's modulus E [Pa], > 0.
      poissons_ratio: Poisson's ratio nu [-], in (-1, 0.5).
      density: rest density [kg/m^3], > 0.
      yield_stress: von Mises yield stress, the Frobenius norm of the deviatoric Kirchhoff stress at yield [Pa], > 0;
        unused without plasticity.
      elasticity, plasticity: the laws (static).
    """

    youngs_modulus: Scalar
    poissons_ratio: Scalar
    density: Scalar
    yield_stress: Scalar = jnp.inf
    elasticity: Elasticity = struct.static_field(default=Elasticity.HENCKY)
    plasticity: Plasticity = struct.static_field(default=Plasticity.NONE)


class LameParameters(NamedTuple):
    shear: Scalar
    """Shear modulus mu [Pa]."""
    first: Scalar
    """First Lame parameter lambda [Pa]."""


class _LawParameters(NamedTuple):
    lame: LameParameters
    yield_stress: Scalar
    sign: Array
    """Sign of det F, shape of the components."""


def lame_parameters(youngs_modulus: Scalar, poissons_ratio: Scalar) -> LameParameters:
    """mu = E / (2 (1 + nu)), lambda = E nu / ((1 + nu) (1 - 2 nu)) [Pa]. Gradient: exact."""
    E, nu = youngs_modulus, poissons_ratio
    return LameParameters(E / (2.0 * (1.0 + nu)), E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)))


def sound_speed(material: Material) -> Scalar:
    """Speed of pressure waves at rest, sqrt((lambda + 2 mu) / density) [m/s]. Gradient: exact."""
    lame = lame_parameters(material.youngs_modulus, material.poissons_ratio)
    return jnp.sqrt((lame.first + 2.0 * lame.shear) / material.density)


def respond(material: Material, F: Mat3) -> tuple[Mat3, Mat3]:
    """Return map and stress in one spectral evaluation, by components.

    Args:
      material: its parameters broadcast against the components of F.
      F: trial deformation gradient [-], components of any shape.

    Returns:
      The elastic deformation gradient after plastic flow [-] and its Kirchhoff stress [Pa].

    Gradient: exact with respect to F and all parameters, forward and reverse; finite at F = I, at repeated
      stretches, for flattened and for inverted particles.
    """
    lame = lame_parameters(material.youngs_modulus, material.poissons_ratio)
    sign = jax.lax.stop_gradient(jnp.where(cp.det(F) < 0, -1.0, 1.0).astype(F[0][0].dtype))
    parameters = _LawParameters(lame, material.yield_stress, sign)
    b = cp.matmul(F, cp.transpose(F))
    if material.plasticity is Plasticity.NONE:
        (tau,) = spectral(functools.partial(_elastic_law, material.elasticity), b, parameters)
        return F, tau
    correction, tau = spectral(functools.partial(_plastic_law, material.elasticity, material.plasticity), b, parameters)
    return cp.matmul(correction, F), tau


def kirchhoff_stress(material: Material, F: Array) -> Array:
    """Kirchhoff stress of the elastic law alone.

    Args:
      material: the solid; its plasticity is ignored.
      F: elastic deformation gradient [-], shape (..., 3, 3).

    Returns:
      tau [Pa], shape (..., 3, 3), symmetric.

    Gradient: exact. Source: Hencky and von Mises: Klar et al. 2016, Drucker-Prager elastoplasticity, section 6;
      fixed corotated: Stomakhin et al. 2012; neo-Hookean: Jiang et al. 2016, MPM course notes, eq. 48, times F^T.
    """
    _, tau = respond(material.replace(plasticity=Plasticity.NONE), cp.split_matrix(F))
    return cp.join_matrix(tau)


def return_map(material: Material, F: Array) -> Array:
    """Elastic deformation gradient after plastic flow.

    Args:
      material: the elastoplastic solid.
      F: trial deformation gradient [-], shape (..., 3, 3).

    Returns:
      Admissible elastic deformation gradient [-], shape (..., 3, 3); F itself inside the yield surface.

    Gradient: exact; at the yield surface the one of the elastic side.
    Source: Gao et al. 2017, "An adaptive generalized interpolation material point method", with the norm of the
      deviatoric strain unguarded, so that the map is idempotent.
    """
    F_new, _ = respond(material, cp.split_matrix(F))
    return cp.join_matrix(F_new)


def elastic_energy_density(material: Material, F: Array) -> Array:
    """Elastic energy per rest volume [J/m^3] of F (..., 3, 3), shape (...). Gradient: exact; P F^T = tau."""
    lame = lame_parameters(material.youngs_modulus, material.poissons_ratio)
    Fc = cp.split_matrix(F)

    def energy(eigenvalues: Vec3, parameters: _LawParameters) -> tuple[Vec3, ...]:
        s = _stretches(eigenvalues, parameters.sign)
        mu, lam = parameters.lame
        J = s[0] * s[1] * s[2]
        if material.elasticity is Elasticity.FIXED_COROTATED:
            psi = mu * sum((a - 1.0) ** 2 for a in s) + 0.5 * lam * (J - 1.0) ** 2
        else:
            e = _log(s)
            trace = e[0] + e[1] + e[2]
            if material.elasticity is Elasticity.HENCKY:
                psi = mu * cp.dot(e, e) + 0.5 * lam * trace**2
            else:
                psi = 0.5 * mu * (cp.dot(s, s) - 3.0) - mu * trace + 0.5 * lam * trace**2
        return ((psi, psi, psi),)

    sign = jax.lax.stop_gradient(jnp.where(cp.det(Fc) < 0, -1.0, 1.0).astype(F.dtype))
    parameters = _LawParameters(lame, material.yield_stress, sign)
    (psi,) = spectral(energy, cp.matmul(Fc, cp.transpose(Fc)), parameters)
    return psi[0][0]


# --- Principal values ------------------------------------------------------------------------------------------------


def _stretches(eigenvalues: Vec3, sign: Array) -> Vec3:
    """Square roots, the smallest with the sign of det F."""
    s = cp.vector(lambda i: jnp.sqrt(jnp.maximum(eigenvalues[i], MIN_STRETCH**2)))
    smallest = jnp.minimum(jnp.minimum(eigenvalues[0], eigenvalues[1]), eigenvalues[2])
    return cp.vector(lambda i: jnp.where(eigenvalues[i] == smallest, sign * s[i], s[i]))


def _log(s: Vec3) -> Vec3:
    return cp.vector(lambda i: jnp.log(jnp.maximum(s[i], MIN_STRETCH)))


def _principal_stress(elasticity: Elasticity, s: Vec3, log_s: Vec3, lame: LameParameters) -> Vec3:
    mu, lam = lame
    trace = log_s[0] + log_s[1] + log_s[2]
    if elasticity is Elasticity.HENCKY:
        return cp.vector(lambda i: 2.0 * mu * log_s[i] + lam * trace)
    if elasticity is Elasticity.NEO_HOOKEAN:
        return cp.vector(lambda i: mu * (s[i] * s[i] - 1.0) + lam * trace)
    J = s[0] * s[1] * s[2]
    return cp.vector(lambda i: 2.0 * mu * (s[i] - 1.0) * s[i] + lam * (J - 1.0) * J)


def _elastic_law(elasticity: Elasticity, eigenvalues: Vec3, parameters: _LawParameters) -> tuple[Vec3]:
    s = _stretches(eigenvalues, parameters.sign)
    return (_principal_stress(elasticity, s, _log(s), parameters.lame),)


def _plastic_law(
    elasticity: Elasticity, plasticity: Plasticity, eigenvalues: Vec3, parameters: _LawParameters
) -> tuple[Vec3, Vec3]:
    """Ratio of new to trial stretch, and stress of the new stretches."""
    assert plasticity is Plasticity.VON_MISES
    s = _stretches(eigenvalues, parameters.sign)
    log_s = materialize(_log(s))
    log_flowed, flows = _von_mises(log_s, parameters)
    # Unless it flows, a particle keeps its trial state, inverted or not.
    new = cp.vector(lambda i: jnp.where(flows, jnp.exp(log_flowed[i]), s[i]))
    log_new = cp.vector(lambda i: jnp.where(flows, log_flowed[i], log_s[i]))
    new, log_new = materialize((new, log_new))
    ratio = cp.vector(lambda i: jnp.where(flows, new[i] / _away_from_zero(s[i]), 1.0))
    return ratio, _principal_stress(elasticity, new, log_new, parameters.lame)


def _von_mises(log_s: Vec3, parameters: _LawParameters) -> tuple[Vec3, Array]:
    """Logarithmic strains after flow, and whether the particle flows."""
    e = cp.vector(lambda i: jnp.maximum(log_s[i], math.log(MIN_PLASTIC_STRETCH)))
    mean = (e[0] + e[1] + e[2]) * (1.0 / 3.0)
    deviator = cp.vector(lambda i: e[i] - mean)
    length = cp.norm(deviator)
    limit = parameters.yield_stress / (2.0 * parameters.lame.shear)
    flows = length > limit
    kept = jnp.where(flows, limit / jnp.where(flows, length, 1.0), 1.0)
    return cp.vector(lambda i: mean + kept * deviator[i]), flows


def _away_from_zero(s: Array) -> Array:
    return jnp.where(jnp.abs(s) < MIN_STRETCH, MIN_STRETCH, s)


__all__ = [
    "Elasticity",
    "LameParameters",
    "Material",
    "Plasticity",
    "elastic_energy_density",
    "kirchhoff_stress",
    "lame_parameters",
    "respond",
    "return_map",
    "sound_speed",
]
