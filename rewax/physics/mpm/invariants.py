"""Conserved quantities: mass, momentum and energy of the particles.

They serve checks of a scene, checks of a change to the code, and logging. Each particle carries an affine velocity
field v + C d (APIC). With quadratic B-splines its second moment is D = dx^2 / 4 I, which determines the angular
momentum and kinetic energy of the field.
"""

import jax.numpy as jnp

from rewax.physics.mpm.materials import Material, elastic_energy_density
from rewax.physics.mpm.stepping import MPMScene, MPMState, particle_mass, per_material, respond_particles
from rewax.physics.numerics import components as cp
from rewax.types import Array


def total_mass(scene: MPMScene, state: MPMState) -> Array:
    """Mass of all particles [kg], shape (). Gradient: exact with respect to density and volume."""
    return jnp.sum(particle_mass(scene, state.x))


def momentum(scene: MPMScene, state: MPMState) -> Array:
    """Linear momentum of all particles [kg m/s], shape (3,).

    It is constant without gravity, colliders and walls.

    Args:
      scene: the scene; its density and particle volume give the masses.
      state: particles.

    Gradient: exact.
    """
    return jnp.sum(particle_mass(scene, state.x)[:, None] * state.v, axis=0)


def angular_momentum(
    scene: MPMScene, state: MPMState, about: Array | tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Array:
    """Angular momentum of all particles [kg m^2/s], shape (3,): sum m r x v + m dx^2/4 axial(C).

    It is constant without gravity, colliders and walls. axial(C)_i = epsilon_ijk C_kj is twice the angular velocity of
    a rigid rotation.

    Args:
      scene: the scene.
      state: particles.
      about: origin of r [m], shape (3,).

    Gradient: exact.
    Source: Jiang et al. 2015, APIC, eq. 11, with the D of quadratic splines.
    """
    mass = particle_mass(scene, state.x)
    orbital = jnp.cross(state.x - jnp.asarray(about, state.x.dtype), state.v)
    C = cp.split_matrix(state.C)
    axial = cp.join_vector((C[2][1] - C[1][2], C[0][2] - C[2][0], C[1][0] - C[0][1]))
    return jnp.sum(mass[:, None] * (orbital + _second_moment(scene) * axial), axis=0)


def kinetic_energy(scene: MPMScene, state: MPMState) -> Array:
    """Kinetic energy of all particles [J], shape (): sum m/2 (|v|^2 + dx^2/4 |C|^2). Gradient: exact.

    The affine part counts: C carries the variation of the grid's velocity around a particle. The transfers never
    increase this sum.
    """
    per_mass = jnp.sum(state.v**2, axis=-1) + _second_moment(scene) * jnp.sum(state.C**2, axis=(-2, -1))
    return 0.5 * jnp.sum(particle_mass(scene, state.x) * per_mass)


def elastic_energy(scene: MPMScene, state: MPMState) -> Array:
    """Elastic energy of all particles [J], shape (), after the pending return map. Gradient: exact."""
    deformed = respond_particles(scene, state)

    def density(material: Material, part: tuple[Array, tuple[Array, ...]]) -> Array:
        F, memory = part
        return elastic_energy_density(material, F, memory[: len(material.initial_memory)])

    return jnp.sum(scene.particle_volume * per_material(scene, density, (deformed.F, deformed.memory)))


def gravitational_energy(scene: MPMScene, state: MPMState) -> Array:
    """Potential energy of all particles in the scene's gravity [J], shape (): -sum m g . x. Gradient: exact."""
    return -jnp.sum(particle_mass(scene, state.x) * jnp.sum(scene.gravity * state.x, axis=-1))


def total_energy(scene: MPMScene, state: MPMState) -> Array:
    """Kinetic, elastic and gravitational energy [J], shape (). Gradient: exact.

    For an elastic body without moving colliders it does not grow, apart from the symplectic integrator's oscillation of
    order dt. The transfers dissipate some of it.
    """
    return kinetic_energy(scene, state) + elastic_energy(scene, state) + gravitational_energy(scene, state)


def _second_moment(scene: MPMScene) -> float:
    """D of quadratic B-splines [m^2]: sum w d d^T = dx^2/4 I."""
    return 0.25 * scene.grid.spacing**2


__all__ = [
    "angular_momentum",
    "elastic_energy",
    "gravitational_energy",
    "kinetic_energy",
    "momentum",
    "total_energy",
    "total_mass",
]
