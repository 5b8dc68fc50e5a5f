"""Constitutive laws in principal values: stretches in, stretches and Kirchhoff stresses out.

``materials`` puts them on particles. All are symmetric under a permutation of the axes, as ``linalg3.spectral`` wants.
"""

import enum
import math
from typing import NamedTuple

import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.elastic_constants import LameParameters
from rewax.types import Array, Scalar

MIN_STRETCH = 1e-5
"""Stretches below this count as this in logarithms and quotients [-]."""
MIN_PLASTIC_STRETCH = 0.01
"""Trial stretches below this count as this in the von Mises return map [-]."""
MIN_SAND_STRETCH = 0.05
"""The same for Drucker-Prager."""
MIN_FLUID_VOLUME = 0.05
"""Fluids compressed to less than this fraction of their volume count as compressed to this [-]."""
MAX_HARDENING = 5.0
"""By how much packed snow can be stiffer than fresh snow [-]."""


class Elasticity(enum.Enum):
    """How stretches s make Kirchhoff stress tau; J = s_1 s_2 s_3."""

    HENCKY = "hencky"
    """tau = 2 mu log s + lambda tr(log s): quadratic in logarithmic strain."""
    FIXED_COROTATED = "fixed_corotated"
    """tau = 2 mu (s - 1) s + lambda (J - 1) J."""
    NEO_HOOKEAN = "neo_hookean"
    """tau = mu (s^2 - 1) + lambda log J."""
    FLUID = "fluid"
    """tau = lambda J (J - 1): pressure only, the reference's water. Shape is forgotten at once."""
    TAIT = "tait"
    """tau = -J p with p = density c^2 / 7 (J^-7 - 1), c the speed of sound. Shape is forgotten at once."""


FLUIDS = (Elasticity.FLUID, Elasticity.TAIT)
TAIT_EXPONENT = 7.0


class Plasticity(enum.Enum):
    """What happens to stretches beyond the yield surface."""

    NONE = "none"
    VON_MISES = "von_mises"
    """The deviator of logarithmic strain is limited to yield_stress / (2 mu), volume is kept."""
    DRUCKER_PRAGER = "drucker_prager"
    """Sand: shear is limited in proportion to pressure, and what is pulled apart carries no stress."""
    SNOW = "snow"
    """Stretches are limited to 1 - critical_compression ... 1 + critical_stretch; what flows changes the moduli."""


class LawParameters(NamedTuple):
    """What the laws use; the defaults are for those that a law does not."""

    lame: LameParameters
    sign: Array
    """Sign of det F, shape of the components."""
    yield_stress: Scalar = 0.0
    friction_angle: Scalar = 0.0
    cohesion: Scalar = 0.0
    critical_compression: Scalar = 0.0
    critical_stretch: Scalar = 0.0
    hardening: Scalar = 0.0
    plastic_volume: Scalar = 1.0


def stretches(eigenvalues: Vec3, sign: Array) -> Vec3:
    """Square roots of the eigenvalues of F F^T, the smallest with the sign of det F."""
    s = cp.vector(lambda i: jnp.sqrt(jnp.maximum(eigenvalues[i], MIN_STRETCH**2)))
    smallest = jnp.minimum(jnp.minimum(eigenvalues[0], eigenvalues[1]), eigenvalues[2])
    return cp.vector(lambda i: jnp.where(eigenvalues[i] == smallest, sign * s[i], s[i]))


def elastic_law(elasticity: Elasticity, eigenvalues: Vec3, parameters: LawParameters) -> tuple[Vec3]:
    """Principal stresses."""
    s = stretches(eigenvalues, parameters.sign)
    return (_principal_stress(elasticity, s, _log(s), parameters.lame),)


def plastic_law(
    elasticity: Elasticity, plasticity: Plasticity, eigenvalues: Vec3, parameters: LawParameters
) -> tuple[Vec3, Vec3]:
    """Ratio of new to trial stretch, and stress of the new stretches."""
    s = stretches(eigenvalues, parameters.sign)
    log_s = materialize(_log(s))
    if plasticity is Plasticity.SNOW:
        low, high = 1.0 - parameters.critical_compression, 1.0 + parameters.critical_stretch
        new = cp.vector(lambda i: jnp.clip(s[i], low, high))
        log_new, flows = _log(new), jnp.ones(s[0].shape, bool)
    else:
        return_map = {Plasticity.VON_MISES: _von_mises, Plasticity.DRUCKER_PRAGER: _drucker_prager}[plasticity]
        log_flowed, flows = return_map(log_s, parameters)
        # Unless it flows, a particle keeps its trial state, inverted or not.
        new = cp.vector(lambda i: jnp.where(flows, jnp.exp(log_flowed[i]), s[i]))
        log_new = cp.vector(lambda i: jnp.where(flows, log_flowed[i], log_s[i]))
    new, log_new = materialize((new, log_new))
    ratio = cp.vector(lambda i: jnp.where(flows, new[i] / _away_from_zero(s[i]), 1.0))
    lame = parameters.lame
    if plasticity is Plasticity.SNOW:
        plastic_volume = parameters.plastic_volume * (s[0] * s[1] * s[2]) / (new[0] * new[1] * new[2])
        harder = jnp.exp(jnp.minimum(parameters.hardening * (1.0 - plastic_volume), math.log(MAX_HARDENING)))
        lame = LameParameters(lame.shear * harder, lame.first * harder)
    return ratio, _principal_stress(elasticity, new, log_new, lame)


def energy_law(elasticity: Elasticity, eigenvalues: Vec3, parameters: LawParameters) -> tuple[Vec3]:
    """Elastic energy per rest volume, three times."""
    s = stretches(eigenvalues, parameters.sign)
    mu, lam = parameters.lame
    J = s[0] * s[1] * s[2]
    if elasticity is Elasticity.FIXED_COROTATED:
        psi = mu * sum((a - 1.0) ** 2 for a in s) + 0.5 * lam * (J - 1.0) ** 2
    else:
        e = _log(s)
        trace = e[0] + e[1] + e[2]
        if elasticity is Elasticity.HENCKY:
            psi = mu * cp.dot(e, e) + 0.5 * lam * trace**2
        else:
            psi = 0.5 * mu * (cp.dot(s, s) - 3.0) - mu * trace + 0.5 * lam * trace**2
    return ((psi, psi, psi),)


def fluid_stress(elasticity: Elasticity, J: Array, lame: LameParameters, bulk_modulus: Scalar) -> Array:
    """Kirchhoff pressure stress, one number per particle; ``bulk_modulus`` is density c^2, for Tait's law."""
    if elasticity is Elasticity.FLUID:
        return lame.first * J * (J - 1.0)
    return (bulk_modulus / TAIT_EXPONENT) * (J - J ** (1.0 - TAIT_EXPONENT))


def fluid_energy(elasticity: Elasticity, J: Array, lame: LameParameters, bulk_modulus: Scalar) -> Array:
    """Elastic energy per rest volume of a fluid; J psi'(J) is its stress."""
    if elasticity is Elasticity.FLUID:
        return 0.5 * lame.first * (J - 1.0) ** 2
    n = TAIT_EXPONENT
    return (bulk_modulus / n) * (J + (J ** (1.0 - n) - n) / (n - 1.0))


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


def _von_mises(log_s: Vec3, parameters: LawParameters) -> tuple[Vec3, Array]:
    """Logarithmic strains after flow, and whether the particle flows."""
    mean, deviator, length = _deviator(log_s, MIN_PLASTIC_STRETCH)
    return _shortened(mean, deviator, length, parameters.yield_stress / (2.0 * parameters.lame.shear))


def _drucker_prager(log_s: Vec3, parameters: LawParameters) -> tuple[Vec3, Array]:
    """Logarithmic strains after flow, and whether the particle flows.

    The cone ends in its apex at the strain ``cohesion`` along each axis, to which all goes that is pulled further. Near
    the apex the direction of the deviator varies arbitrarily fast but is multiplied by the room that the cone leaves,
    so the derivative stays bounded; at the apex it is that of the particle's side.
    """
    mu, lam = parameters.lame
    mean, deviator, length = _deviator(log_s, MIN_SAND_STRETCH)
    sine = jnp.sin(parameters.friction_angle)
    slope = math.sqrt(2.0 / 3.0) * 2.0 * sine / (3.0 - sine)
    compression = jnp.maximum(3.0 * (parameters.cohesion - mean), 0.0)
    limit = (3.0 * lam + 2.0 * mu) / (2.0 * mu) * compression * slope
    flowed, flows = _shortened(mean, deviator, length, limit)
    pulled = compression <= 0.0
    return cp.vector(lambda i: jnp.where(pulled, parameters.cohesion, flowed[i])), flows | pulled


def _deviator(log_s: Vec3, least: float) -> tuple[Array, Vec3, Array]:
    """Mean, deviator and its length of logarithmic strains that are at least log(least)."""
    e = cp.vector(lambda i: jnp.maximum(log_s[i], math.log(least)))
    mean = (e[0] + e[1] + e[2]) * (1.0 / 3.0)
    deviator = cp.vector(lambda i: e[i] - mean)
    return mean, deviator, cp.norm(deviator)


def _shortened(mean: Array, deviator: Vec3, length: Array, limit: Scalar) -> tuple[Vec3, Array]:
    """The strain with its deviator cut to the limit, and whether that was necessary."""
    flows = length > limit
    kept = jnp.where(flows, limit / jnp.where(flows, length, 1.0), 1.0)
    return cp.vector(lambda i: mean + kept * deviator[i]), flows


def _away_from_zero(s: Array) -> Array:
    return jnp.where(jnp.abs(s) < MIN_STRETCH, MIN_STRETCH, s)
