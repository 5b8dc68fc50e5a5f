"""Materials of particles: any combination of elasticity, plasticity, viscosity and active stress.

``laws`` defines the laws; this module evaluates them on particles, by components. Kirchhoff stress tau = J sigma. An
inverted particle (det F < 0) has a minus sign on its smallest principal stretch.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.physics.mpm.laws.base import (
    ActiveStress,
    Elasticity,
    Fluid,
    Law,
    Parameters,
    Plasticity,
    Viscosity,
    elastic_law,
    energy_law,
    plastic_law,
)
from rewax.physics.mpm.laws.fluids import MIN_FLUID_VOLUME
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.arguments import check_pytree
from rewax.physics.numerics.checks import POSITIVE
from rewax.physics.numerics.components import Mat3
from rewax.physics.numerics.fields import check_fields, instance, optional
from rewax.physics.numerics.linalg3 import spectral
from rewax.types import Array, Scalar


@struct.dataclass
class Material(struct.Replaceable):
    """An isotropic material, composed of laws.

    Parameters of the material and of its laws are numbers, or arrays of shape (num_particles,).

    Attributes:
      density: rest density [kg/m^3], > 0.
      elasticity: ``Hencky``, ``FixedCorotated``, ``NeoHookean``, ``QuadraticFluid``, ``Tait`` or another
        ``Elasticity``.
      plasticity: ``VonMises``, ``DruckerPrager``, ``Snow`` or another ``Plasticity``; None: no plastic flow.
      viscosity: ``Newtonian`` or another ``Viscosity``; None: no viscous stress.
      muscle: ``Muscle`` or another ``ActiveStress``; None: passive.

    Raises:
      ValueError: a value that is no such law, or whose class is not decorated with ``struct.dataclass``; a fluid with a
        plasticity.

    Example:
      >>> dough = Material(
      ...     density=1e3,
      ...     elasticity=Hencky(youngs_modulus=5e3, poissons_ratio=0.2),
      ...     plasticity=VonMises(yield_stress=50.0),
      ... )
    """

    density: Scalar = struct.number(POSITIVE, "give the rest density in kg/m^3")
    elasticity: Elasticity
    plasticity: Plasticity | None = None
    viscosity: Viscosity | None = None
    muscle: ActiveStress | None = None

    def __post_init__(self) -> None:
        check_fields(_LAWS, vars(self))
        for name, law in self.laws.items():
            check_pytree(name, law)
        if isinstance(self.elasticity, Fluid) and self.plasticity is not None:
            raise ValueError(
                f"plasticity is {type(self.plasticity).__name__} with {type(self.elasticity).__name__}, a fluid, which "
                "has no yield surface: leave plasticity out, or give the elasticity of a solid"
            )

    @property
    def laws(self) -> dict[str, Law]:
        """The laws by field name, without absent ones."""
        return {name: law for name in _LAWS if (law := getattr(self, name)) is not None}

    @property
    def initial_memory(self) -> tuple[float, ...]:
        """Initial history variables of each particle."""
        return () if self.plasticity is None else self.plasticity.initial_memory

    @property
    def look(self) -> str:
        """How viewers draw it: "water", "muscle", "dough", "sand", "snow" or "elastic"."""
        looks = [law.look for law in self.laws.values() if law.look is not None]
        return "water" if "water" in looks else (looks[-1] if looks else "elastic")


_LAWS = {
    "elasticity": instance(Elasticity, "give a law, elasticity=Hencky(youngs_modulus=..., poissons_ratio=...)"),
    "plasticity": optional(instance(Plasticity, "give a law, plasticity=VonMises(yield_stress=...), or None")),
    "viscosity": optional(instance(Viscosity, "give a law, viscosity=Newtonian(viscosity=...), or None")),
    "muscle": optional(instance(ActiveStress, "give a law, muscle=Muscle(fibre=..., activation=...), or None")),
}


class Response(NamedTuple):
    """Result of return map and stress law for a trial state, by components."""

    F: Mat3
    """Elastic deformation gradient after plastic flow [-]."""
    stress: Mat3
    """Kirchhoff stress [Pa]."""
    memory: tuple[Array, ...]
    """History variables of plasticity, one array for each entry of ``Material.initial_memory``."""


def sound_speed(material: Material) -> Scalar:
    """Speed of pressure waves at rest [m/s]. Gradient: exact."""
    return material.elasticity.sound_speed(material.density)


def respond(
    material: Material, F: Mat3, *, velocity_gradient: Mat3 | None = None, memory: tuple[Array, ...] = ()
) -> Response:
    """Return map and stress in one evaluation, by components.

    Args:
      material: its parameters broadcast against the components of F.
      F: trial deformation gradient [-], components of any shape.
      velocity_gradient: C [1/s], for viscous materials.
      memory: history variables, one array for each entry of ``Material.initial_memory``.

    Gradient: exact with respect to F, C, memory and all parameters, forward and reverse. It is finite at F = I, at
      repeated stretches, for flattened and for inverted particles; on yield surfaces it is that of one side.
    """
    if isinstance(material.elasticity, Fluid):
        F_new, tau = _fluid(material, material.elasticity, F)
        memory = ()
    else:
        F_new, tau, memory = _solid(material, F, memory)
    if material.viscosity is not None:
        if velocity_gradient is None:
            raise ValueError("the material is viscous: give velocity_gradient")
        tau = cp.add_matrices(tau, material.viscosity.stress(F_new, velocity_gradient))
    if material.muscle is not None:
        tau = cp.add_matrices(tau, material.muscle.stress(F_new))
    return Response(F_new, tau, memory)


class Parameter(NamedTuple):
    """A parameter of a material or of one of its laws."""

    law: str
    """The law's field in the material; empty: the material's own."""
    name: str
    value: Any
    is_vector: bool

    @property
    def path(self) -> str:
        """Path for ``struct.replace_leaf``: ``"elasticity.youngs_modulus"``."""
        return f"{self.law}.{self.name}" if self.law else self.name

    @property
    def per_particle(self) -> bool:
        """Whether the value is an array with one entry per particle."""
        return self.value is not None and jnp.ndim(self.value) > self.is_vector


def parameters_of(material: Material) -> Iterator[Parameter]:
    """All fields of the material and its laws that ``struct.number`` declares."""
    for law, part in {"": material, **material.laws}.items():
        for field in dataclasses.fields(part):  # type: ignore[arg-type]
            if "number" in field.metadata:
                yield Parameter(law, field.name, getattr(part, field.name), field.metadata["vector"])


def split_parameters(material: Material) -> tuple[Material, dict[str, Array]]:
    """The material with shared parameters only, and the parameters per particle: (num_particles,), vectors (3, ...)."""
    own = {p.path: jnp.asarray(p.value).T for p in parameters_of(material) if p.per_particle}
    return _replaced(material, dict.fromkeys(own)), own


def joined_parameters(material: Material, own: dict[str, Array]) -> Material:
    """Inverse of ``split_parameters``, also for a subset of the particles."""
    return _replaced(material, {name: value.T for name, value in own.items()})


def _replaced(material: Material, values: dict[str, Any]) -> Material:
    for path, value in values.items():
        material = struct.replace_leaf(material, path, value)
    return material


def kirchhoff_stress(material: Material, F: Array) -> Array:
    """Kirchhoff stress of the elastic law, without the other laws.

    Args:
      material: only its elasticity is used.
      F: elastic deformation gradient [-], shape (..., 3, 3).

    Returns:
      tau [Pa], shape (..., 3, 3), symmetric.

    Gradient: exact. Source: see the law.
    """
    alone = material.replace(plasticity=None, viscosity=None, muscle=None)
    return cp.join_matrix(respond(alone, cp.split_matrix(F)).stress)


def return_map(material: Material, F: Array, memory: tuple[Array, ...] = ()) -> Array:
    """Elastic deformation gradient after plastic flow.

    Args:
      material: only its elasticity and plasticity are used.
      F: trial deformation gradient [-], shape (..., 3, 3).
      memory: history variables, arrays of shape (...), one for each entry of ``Material.initial_memory``.

    Returns:
      Admissible elastic deformation gradient [-], shape (..., 3, 3); F itself inside the yield surface.

    Gradient: exact; at the yield surface that of the elastic side. Source: see the law.
    """
    return cp.join_matrix(respond(material.replace(viscosity=None), cp.split_matrix(F), memory=memory).F)


def elastic_energy_density(material: Material, F: Array, memory: tuple[Array, ...] = ()) -> Array:
    """Elastic energy per rest volume [J/m^3].

    Args:
      material: its elasticity and the hardening of its plasticity are used.
      F: elastic deformation gradient [-], shape (..., 3, 3).
      memory: as for ``return_map``; empty: the initial values.

    Returns:
      psi, shape (...).

    Gradient: exact; P F^T = tau.
    """
    Fc = cp.split_matrix(F)
    if isinstance(material.elasticity, Fluid):
        return material.elasticity.energy_of_volume(jnp.maximum(cp.det(Fc), MIN_FLUID_VOLUME), material.density)
    if not memory:
        memory = tuple(jnp.full_like(Fc[0][0], a) for a in material.initial_memory)
    (psi,) = spectral(energy_law, cp.matmul(Fc, cp.transpose(Fc)), _parameters(material, Fc, memory))
    return psi


def is_inverted(material: Material, F: Array, memory: Array | None) -> Array:
    """Whether each particle is flattened or turned inside out, or has been as far as its history variables tell.

    Args:
      material: its plasticity reads the history variables.
      F: trial elastic deformation gradient [-], shape (num_particles, 3, 3).
      memory: history variables, as in ``MPMState.memory``.

    Returns:
      Truth, shape (num_particles,), bool. Gradient: none.
    """
    now = cp.det(cp.split_matrix(F)) <= 0.0
    if memory is None or material.plasticity is None:
        return now
    return now | material.plasticity.was_inverted(tuple(memory[:, i] for i in range(len(material.initial_memory))))


def _solid(material: Material, F: Mat3, memory: tuple[Array, ...]) -> tuple[Mat3, Mat3, tuple[Array, ...]]:
    if len(memory) != len(material.initial_memory):
        raise ValueError(
            f"memory has {len(memory)} arrays, but {type(material.plasticity).__name__} needs "
            f"{len(material.initial_memory)}: begin with mpm.initial_state(x, scene)"
        )
    b, parameters = cp.matmul(F, cp.transpose(F)), _parameters(material, F, memory)
    if material.plasticity is None:
        (tau,) = spectral(elastic_law, b, parameters)
        return F, tau, ()
    elongation, tau, *memory_new = spectral(plastic_law, b, parameters)
    # The sum leaves F unchanged where nothing flows. With a product, rounding of ratios near 1 would make volume creep.
    return cp.add_matrices(F, cp.matmul(elongation, F)), tau, tuple(memory_new)


def _fluid(material: Material, fluid: Fluid, F: Mat3) -> tuple[Mat3, Mat3]:
    """A fluid forgets its shape: F becomes J^(1/3) I."""
    J = jnp.maximum(cp.det(F), MIN_FLUID_VOLUME)
    side = jnp.cbrt(J)
    pressure = fluid.stress(J, material.density)
    zero = jnp.zeros_like(J)
    return _isotropic(side, zero), _isotropic(pressure, zero)


def _isotropic(a: Array, zero: Array) -> Mat3:
    return cp.matrix(lambda i, j: a if i == j else zero)


def _parameters(material: Material, F: Mat3, memory: tuple[Array, ...]) -> Parameters:
    sign = jax.lax.stop_gradient(jnp.where(cp.det(F) < 0, -1.0, 1.0).astype(F[0][0].dtype))
    return Parameters(material.elasticity, material.plasticity, sign, memory)


__all__ = [
    "Material",
    "Parameter",
    "Response",
    "elastic_energy_density",
    "is_inverted",
    "joined_parameters",
    "kirchhoff_stress",
    "parameters_of",
    "respond",
    "return_map",
    "sound_speed",
    "split_parameters",
]
