"""Constitutive laws in principal values: stretches in, stretches and Kirchhoff stresses out.

``materials`` puts them on particles. All are symmetric under a permutation of the axes and give divided differences, as
``linalg3.spectral`` wants.
"""

import enum
import math
from typing import NamedTuple

import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.physics.numerics import components as cp
from rewax.physics.numerics import divided_differences as dd
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.divided_differences import Principal
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


def stretches(eigenvalues: Principal, sign: Array) -> Principal:
    """Square roots of the eigenvalues of F F^T, the smallest with the sign of det F."""
    root = dd.sqrt(dd.maximum(eigenvalues, MIN_STRETCH**2))
    a, b, c = eigenvalues.values
    smallest = jnp.minimum(jnp.minimum(a, b), c)
    signs = cp.vector(lambda i: jnp.where(eigenvalues.values[i] == smallest, sign, 1.0))
    s = cp.vector(lambda i: signs[i] * root.values[i])
    if root.differences is None:
        return Principal(s)
    alike = root.differences

    def difference(i: int, j: int, k: int) -> Array:
        """Of signs that differ it is unbounded where sizes are equal, and there it counts as zero."""
        gap = eigenvalues.values[i] - eigenvalues.values[j]
        near = jnp.abs(gap) < jnp.finfo(gap.dtype).eps ** (1 / 3) * (root.values[i] + root.values[j]) ** 2
        differ = jnp.where(near, 0.0, (s[i] - s[j]) * dd.inverse_gap(eigenvalues.values, i, j))
        return jnp.where(signs[i] == signs[j], signs[i] * alike[k], differ)

    return Principal(s, cp.vector(lambda k: difference(*dd.PAIRS[k], k)))


def elastic_law(elasticity: Elasticity, eigenvalues: Principal, parameters: LawParameters) -> tuple[Principal]:
    """Principal stresses."""
    s = stretches(eigenvalues, parameters.sign)
    return (_principal_stress(elasticity, s, _log(s), parameters.lame),)


def plastic_law(
    elasticity: Elasticity, plasticity: Plasticity, eigenvalues: Principal, parameters: LawParameters
) -> tuple[Principal, Principal]:
    """Elongation by plastic flow, new over trial stretch minus one, and stress of the new stretches.

    What does not flow has elongation zero. A ratio would be 1 up to rounding, and volume would creep.
    """
    s = stretches(eigenvalues, parameters.sign)
    log_s = materialize(_log(s))
    if plasticity is Plasticity.SNOW:
        low, high = 1.0 - parameters.critical_compression, 1.0 + parameters.critical_stretch
        new = dd.minimum(dd.maximum(s, low), high)
        log_new, elongation = _log(new), _elongation(s, new, None)
    else:
        return_map, least = {
            Plasticity.VON_MISES: (_von_mises, MIN_PLASTIC_STRETCH),
            Plasticity.DRUCKER_PRAGER: (_drucker_prager, MIN_SAND_STRETCH),
        }[plasticity]
        at_least = dd.maximum(log_s, math.log(least))
        change, flows = return_map(at_least, parameters)
        floor = dd.maximum(s, least)
        # Unless it flows, a particle keeps its trial state, inverted or not.
        new = dd.select(flows, dd.multiply(floor, dd.exp(change)), s)
        log_new = dd.select(flows, dd.add(at_least, change), log_s)
        elongation = dd.select(flows, _elongation(s, floor, change), dd.uniform(jnp.zeros_like(s.values[0]), s))
    new, log_new = materialize((new, log_new))
    lame = parameters.lame
    if plasticity is Plasticity.SNOW:
        plastic_volume = parameters.plastic_volume * _product(s.values) / _product(new.values)
        harder = jnp.exp(jnp.minimum(parameters.hardening * (1.0 - plastic_volume), math.log(MAX_HARDENING)))
        lame = LameParameters(lame.shear * harder, lame.first * harder)
    return elongation, _principal_stress(elasticity, new, log_new, lame)


def energy_law(elasticity: Elasticity, eigenvalues: Principal, parameters: LawParameters) -> tuple[Principal]:
    """Elastic energy per rest volume, three times."""
    stretch = stretches(eigenvalues, parameters.sign)
    s = stretch.values
    mu, lam = parameters.lame
    if elasticity is Elasticity.FIXED_COROTATED:
        psi = mu * sum((a - 1.0) ** 2 for a in s) + 0.5 * lam * (_product(s) - 1.0) ** 2
    else:
        e = _log(stretch).values
        trace = e[0] + e[1] + e[2]
        if elasticity is Elasticity.HENCKY:
            psi = mu * cp.dot(e, e) + 0.5 * lam * trace**2
        else:
            psi = 0.5 * mu * (cp.dot(s, s) - 3.0) - mu * trace + 0.5 * lam * trace**2
    return (dd.uniform(psi, stretch),)


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


def _log(s: Principal) -> Principal:
    return dd.log(dd.maximum(s, MIN_STRETCH))


def _product(s: Vec3) -> Array:
    return s[0] * s[1] * s[2]


def _principal_stress(elasticity: Elasticity, s: Principal, log_s: Principal, lame: LameParameters) -> Principal:
    mu, lam = lame
    trace = log_s.values[0] + log_s.values[1] + log_s.values[2]
    if elasticity is Elasticity.HENCKY:
        return dd.shift(dd.scale(2.0 * mu, log_s), lam * trace)
    if elasticity is Elasticity.NEO_HOOKEAN:
        return dd.shift(dd.scale(mu, dd.shift(dd.multiply(s, s), -1.0)), lam * trace)
    J = _product(s.values)
    return dd.shift(dd.scale(2.0 * mu, dd.multiply(dd.shift(s, -1.0), s)), lam * (J - 1.0) * J)


def _elongation(s: Principal, floor: Principal, change: Principal | None) -> Principal:
    """floor exp(change) / s - 1, exactly zero where floor is s and the change of logarithmic strain is zero."""
    ratio = dd.multiply(floor, dd.reciprocal(s))
    more = cp.subtract(floor.values, s.values)
    if change is not None:
        ratio, growth = dd.multiply(ratio, dd.exp(change)), dd.expm1(change)
        more = cp.vector(lambda i: more[i] + floor.values[i] * growth.values[i])
    return ratio._replace(values=cp.vector(lambda i: more[i] / s.values[i]))


def _von_mises(log_s: Principal, parameters: LawParameters) -> tuple[Principal, Array]:
    """What flow adds to logarithmic strains, and whether the particle flows."""
    _, deviator, length = _deviator(log_s)
    return _shortening(deviator, length, parameters.yield_stress / (2.0 * parameters.lame.shear))


def _drucker_prager(log_s: Principal, parameters: LawParameters) -> tuple[Principal, Array]:
    """What flow adds to logarithmic strains, and whether the particle flows.

    The cone ends in its apex at the strain ``cohesion`` along each axis, to which all goes that is pulled further. Near
    the apex the direction of the deviator varies arbitrarily fast but is multiplied by the room that the cone leaves,
    so the derivative stays bounded; at the apex it is that of the particle's side.
    """
    mu, lam = parameters.lame
    mean, deviator, length = _deviator(log_s)
    sine = jnp.sin(parameters.friction_angle)
    slope = math.sqrt(2.0 / 3.0) * 2.0 * sine / (3.0 - sine)
    compression = jnp.maximum(3.0 * (parameters.cohesion - mean), 0.0)
    limit = (3.0 * lam + 2.0 * mu) / (2.0 * mu) * compression * slope
    shortening, flows = _shortening(deviator, length, limit)
    pulled = compression <= 0.0
    to_apex = dd.shift(dd.scale(-1.0, log_s), parameters.cohesion)
    return dd.select(pulled, to_apex, shortening), flows | pulled


def _deviator(log_s: Principal) -> tuple[Array, Principal, Array]:
    """Mean, deviator and its length of logarithmic strains."""
    e = log_s.values
    mean = (e[0] + e[1] + e[2]) * (1.0 / 3.0)
    deviator = dd.shift(log_s, -mean)
    return mean, deviator, cp.norm(deviator.values)


def _shortening(deviator: Principal, length: Array, limit: Scalar) -> tuple[Principal, Array]:
    """What cuts the deviator to the limit, and whether that is necessary."""
    flows = length > limit
    return dd.scale(jnp.where(flows, limit / jnp.where(flows, length, 1.0) - 1.0, 0.0), deviator), flows
