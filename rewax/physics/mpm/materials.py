"""What particles are made of: elasticity, plasticity, viscosity and muscles, composed freely.

Every elastic and plastic law here needs only the left Cauchy-Green tensor b = F F^T = U diag(s^2) U^T: an elastic law
maps principal stretches s to principal Kirchhoff stresses tau, a return map maps trial stretches to admissible ones
(``laws``). So any elasticity goes with any plasticity, and both share one spectral evaluation whose derivative is exact
(``linalg3``). Fluids need only J = det F. Viscous and active stresses are added.

Kirchhoff stress tau = J sigma. Stretches of an inverted particle (det F < 0) carry a minus sign on the smallest one.
"""

import enum
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.physics.mpm.laws import (
    FLUIDS,
    MIN_FLUID_VOLUME,
    Elasticity,
    LawParameters,
    Plasticity,
    elastic_law,
    energy_law,
    fluid_energy,
    fluid_stress,
    plastic_law,
)
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import check_enum
from rewax.physics.numerics.components import Mat3
from rewax.physics.numerics.elastic_constants import LameParameters, lame_parameters
from rewax.physics.numerics.linalg3 import spectral
from rewax.types import Array, Scalar


@struct.dataclass
class Material(struct.Replaceable):
    """An isotropic material. Parameters are numbers, or arrays of shape (num_particles,) that differ per particle.

    Those of laws that a material does not use keep their defaults: ``make_scene`` refuses them.

    Attributes:
      youngs_modulus: Young's modulus E [Pa], > 0; unused by ``TAIT``.
      poissons_ratio: Poisson's ratio nu [-], in (-1, 0.5); unused by ``TAIT``.
      density: rest density [kg/m^3], > 0.
      yield_stress: von Mises yield stress, the Frobenius norm of the deviatoric Kirchhoff stress at yield [Pa], > 0.
      friction_angle: of ``DRUCKER_PRAGER`` [rad], in (0, pi / 2).
      cohesion: logarithmic strain along each axis to which ``DRUCKER_PRAGER`` can be pulled [-], >= 0 (None: 0).
      critical_compression, critical_stretch: of ``SNOW`` [-], > 0 (fresh: 0.025 and 0.0075).
      hardening: of ``SNOW`` [-]: moduli grow by exp(hardening (1 - plastic volume)), at most fivefold
        (fresh: 10).
      viscosity: dynamic (Newtonian) viscosity [Pa s], >= 0; None: no viscous stress.
      speed_of_sound: of ``TAIT`` [m/s], > 0.
      fibre: direction of muscle fibres in the undeformed body, unit vectors of shape (3,) or (num_particles, 3).
      activation: active stress along the deformed fibres [Pa], positive pulls together.
      elasticity, plasticity: the laws (static).
    """

    youngs_modulus: Scalar = 0.0
    poissons_ratio: Scalar = 0.0
    density: Scalar
    yield_stress: Scalar = jnp.inf
    friction_angle: Scalar | None = None
    cohesion: Scalar | None = None
    critical_compression: Scalar | None = None
    critical_stretch: Scalar | None = None
    hardening: Scalar | None = None
    viscosity: Scalar | None = None
    speed_of_sound: Scalar | None = None
    fibre: Array | None = None
    activation: Scalar | None = None
    elasticity: Elasticity = struct.static_field(default=Elasticity.HENCKY)
    plasticity: Plasticity = struct.static_field(default=Plasticity.NONE)

    def __post_init__(self) -> None:
        check_enum("elasticity", self.elasticity, Elasticity)
        check_enum("plasticity", self.plasticity, Plasticity)

    @property
    def remembers(self) -> bool:
        """Whether particles carry ``MPMState.plastic_volume``."""
        return self.plasticity is Plasticity.SNOW


class Response(NamedTuple):
    """What a material makes of a trial state, by components."""

    F: Mat3
    """Elastic deformation gradient after plastic flow [-]."""
    stress: Mat3
    """Kirchhoff stress [Pa]."""
    plastic_volume: Array | None
    """Volume ratio of all plastic flow so far [-]; None for materials that do not remember it."""


def sound_speed(material: Material) -> Scalar:
    """Speed of pressure waves at rest [m/s]: sqrt((lambda + 2 mu) / density), fluids without mu. Gradient: exact."""
    if material.elasticity is Elasticity.TAIT:
        assert material.speed_of_sound is not None
        return material.speed_of_sound
    mu, lam = lame_parameters(material.youngs_modulus, material.poissons_ratio)
    return jnp.sqrt((lam if material.elasticity is Elasticity.FLUID else lam + 2.0 * mu) / material.density)


def respond(
    material: Material, F: Mat3, *, velocity_gradient: Mat3 | None = None, plastic_volume: Array | None = None
) -> Response:
    """Return map and stress in one evaluation, by components.

    Args:
      material: its parameters broadcast against the components of F.
      F: trial deformation gradient [-], components of any shape.
      velocity_gradient: C [1/s], for viscous materials.
      plastic_volume: volume ratio of earlier plastic flow [-], for materials that remember it.

    Gradient: exact with respect to F, C and all parameters, forward and reverse; finite at F = I, at repeated
      stretches, for flattened and for inverted particles; on yield surfaces that of one side.
    """
    if material.elasticity in FLUIDS:
        F_new, tau = _fluid(material, F)
    else:
        F_new, tau, plastic_volume = _solid(material, F, plastic_volume)
    if material.viscosity is not None:
        if velocity_gradient is None:
            raise ValueError("the material is viscous: give velocity_gradient")
        tau = cp.add_matrices(tau, _viscous_stress(material.viscosity, F_new, velocity_gradient))
    if material.fibre is not None and material.activation is not None:
        along = cp.matvec(F_new, cp.split_vector(jnp.asarray(material.fibre)))
        tau = cp.matrix(lambda i, j: tau[i][j] + material.activation * along[i] * along[j])
    return Response(F_new, tau, plastic_volume if material.remembers else None)


def split_parameters(material: Material) -> tuple[Material, dict[str, Array]]:
    """Parameters that all particles share, and those of which each has its own, (num_particles,), fibres (3, ...)."""
    own = {}
    for name, value in vars(material).items():
        if isinstance(value, (type(None), enum.Enum)) or jnp.ndim(value) < (2 if name == "fibre" else 1):
            continue
        own[name] = jnp.asarray(value).T
    return material.replace(**dict.fromkeys(own)), own


def joined_parameters(material: Material, own: dict[str, Array]) -> Material:
    """Inverse of ``split_parameters``, for some of the particles."""
    return material.replace(**{name: value.T for name, value in own.items()})


def kirchhoff_stress(material: Material, F: Array) -> Array:
    """Kirchhoff stress of the elastic law alone.

    Args:
      material: its elasticity counts.
      F: elastic deformation gradient [-], shape (..., 3, 3).

    Returns:
      tau [Pa], shape (..., 3, 3), symmetric.

    Gradient: exact. Source: Hencky and von Mises: Klar et al. 2016, Drucker-Prager elastoplasticity, section 6;
      fixed corotated: Stomakhin et al. 2012; neo-Hookean: Jiang et al. 2016, MPM course notes, eq. 48, times F^T.
    """
    alone = material.replace(plasticity=Plasticity.NONE, viscosity=None, fibre=None)
    return cp.join_matrix(respond(alone, cp.split_matrix(F)).stress)


def return_map(material: Material, F: Array, plastic_volume: Array | None = None) -> Array:
    """Elastic deformation gradient after plastic flow.

    Args:
      material: its plasticity counts.
      F: trial deformation gradient [-], shape (..., 3, 3).
      plastic_volume: volume ratio of earlier plastic flow [-], shape (...), for materials that remember it.

    Returns:
      Admissible elastic deformation gradient [-], shape (..., 3, 3); F itself inside the yield surface.

    Gradient: exact; at the yield surface the one of the elastic side.
    Source: von Mises: Gao et al. 2017, "An adaptive generalized interpolation material point method", with the norm
      of the deviatoric strain unguarded, so that the map is idempotent. Drucker-Prager: Klar et al. 2016, without the
      volume correction. Snow: Stomakhin et al. 2013, "A material point method for snow simulation".
    """
    response = respond(material.replace(viscosity=None), cp.split_matrix(F), plastic_volume=plastic_volume)
    return cp.join_matrix(response.F)


def elastic_energy_density(material: Material, F: Array) -> Array:
    """Elastic energy per rest volume [J/m^3] of F (..., 3, 3), shape (...). Gradient: exact; P F^T = tau."""
    Fc = cp.split_matrix(F)
    if material.elasticity in FLUIDS:
        J = jnp.maximum(cp.det(Fc), MIN_FLUID_VOLUME)
        return fluid_energy(material.elasticity, J, _lame(material), _bulk_modulus(material))
    law = functools.partial(energy_law, material.elasticity)
    (psi,) = spectral(law, cp.matmul(Fc, cp.transpose(Fc)), _law_parameters(material, Fc, None))
    return psi[0][0]


def _solid(material: Material, F: Mat3, plastic_volume: Array | None) -> tuple[Mat3, Mat3, Array | None]:
    b = cp.matmul(F, cp.transpose(F))
    if material.remembers and plastic_volume is None:
        raise ValueError(
            "snow remembers its plastic volume, which is missing: begin with mpm.initial_state(x, scene), or give ones"
        )
    parameters = _law_parameters(material, F, plastic_volume)
    if material.plasticity is Plasticity.NONE:
        (tau,) = spectral(functools.partial(elastic_law, material.elasticity), b, parameters)
        return F, tau, None
    law = functools.partial(plastic_law, material.elasticity, material.plasticity)
    elongation, tau = spectral(law, b, parameters)
    # Added, it leaves F as it is where nothing flows. Multiplied by a ratio near 1, volume would creep by rounding.
    F_new = cp.add_matrices(F, cp.matmul(elongation, F))
    if material.remembers:
        assert plastic_volume is not None
        ratio = cp.matrix(lambda i, j: elongation[i][j] + 1.0 if i == j else elongation[i][j])
        # Its determinant is det F_new / det F, finite for flattened particles too.
        plastic_volume = plastic_volume / cp.det(ratio)
    return F_new, tau, plastic_volume


def _fluid(material: Material, F: Mat3) -> tuple[Mat3, Mat3]:
    """A fluid forgets its shape: F becomes J^(1/3) I."""
    J = jnp.maximum(cp.det(F), MIN_FLUID_VOLUME)
    side = jnp.cbrt(J)
    pressure = fluid_stress(material.elasticity, J, _lame(material), _bulk_modulus(material))
    zero = jnp.zeros_like(J)
    return _isotropic(side, zero), _isotropic(pressure, zero)


def _isotropic(a: Array, zero: Array) -> Mat3:
    return cp.matrix(lambda i, j: a if i == j else zero)


def _viscous_stress(viscosity: Scalar, F: Mat3, C: Mat3) -> Mat3:
    """2 J viscosity dev(sym C)."""
    J = cp.det(F)
    mean = (C[0][0] + C[1][1] + C[2][2]) * (1.0 / 3.0)
    return cp.matrix(lambda i, j: J * viscosity * (C[i][j] + C[j][i] - (2.0 * mean if i == j else 0.0)))


def _law_parameters(material: Material, F: Mat3, plastic_volume: Array | None) -> LawParameters:
    """The material's parameters; those that its laws do not use stay out, so that nothing carries their zeros."""
    sign = jax.lax.stop_gradient(jnp.where(cp.det(F) < 0, -1.0, 1.0).astype(F[0][0].dtype))
    parameters = LawParameters(_lame(material), sign)
    if material.plasticity is Plasticity.VON_MISES:
        return parameters._replace(yield_stress=material.yield_stress)
    if material.plasticity is Plasticity.DRUCKER_PRAGER:
        cohesion = 0.0 if material.cohesion is None else material.cohesion
        return parameters._replace(friction_angle=material.friction_angle, cohesion=cohesion)
    if material.plasticity is Plasticity.SNOW and plastic_volume is not None:
        names = ("critical_compression", "critical_stretch", "hardening")
        return parameters._replace(plastic_volume=plastic_volume, **{name: getattr(material, name) for name in names})
    return parameters


def _lame(material: Material) -> LameParameters:
    return lame_parameters(material.youngs_modulus, material.poissons_ratio)


def _bulk_modulus(material: Material) -> Scalar:
    return 0.0 if material.speed_of_sound is None else material.density * material.speed_of_sound**2


__all__ = [
    "Elasticity",
    "LameParameters",
    "Material",
    "Plasticity",
    "Response",
    "elastic_energy_density",
    "joined_parameters",
    "kirchhoff_stress",
    "respond",
    "return_map",
    "sound_speed",
    "split_parameters",
]
