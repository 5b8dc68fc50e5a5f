"""Conserved quantities of tetrahedra: energy and momentum."""

import jax.numpy as jnp

from rewax.physics.numerics import components as cp
from rewax.physics.tets.law import energy_density
from rewax.physics.tets.scene import TetScene, TetState, check_vertices
from rewax.physics.tets.stepping import deformation, rest
from rewax.types import Array


def elastic_energy(scene: TetScene, state: TetState) -> Array:
    """Elastic energy [J], shape (); zero at rest without activation. Gradient: exact."""
    check_vertices(scene, state)
    F = deformation(scene, rest(scene), cp.split_vector(state.x))
    return jnp.sum(scene.rest_volume * energy_density(F, scene.mu, scene.lam, scene.activation))


def kinetic_energy(scene: TetScene, state: TetState) -> Array:
    """Kinetic energy [J], shape (): sum m/2 |v|^2. Gradient: exact."""
    return 0.5 * jnp.sum(scene.mass * jnp.sum(state.v**2, axis=-1))


def gravitational_energy(scene: TetScene, state: TetState) -> Array:
    """Potential energy in the scene's gravity [J], shape (): -sum m g . x. Gradient: exact."""
    return -jnp.sum(scene.mass * jnp.sum(scene.gravity * state.x, axis=-1))


def momentum(scene: TetScene, state: TetState) -> Array:
    """Linear momentum [kg m/s], shape (3,): constant without gravity, contact and held vertices. Gradient: exact."""
    return jnp.sum(scene.mass[:, None] * state.v, axis=0)


def angular_momentum(
    scene: TetScene, state: TetState, about: Array | tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Array:
    """Angular momentum about a point [kg m^2/s], shape (3,): sum m r x v.

    It is constant without gravity, contact, held vertices and damping by ``DampingLaw.VELOCITY_GRADIENT``. Gradient:
    exact.
    """
    return jnp.sum(scene.mass[:, None] * jnp.cross(state.x - jnp.asarray(about, state.x.dtype), state.v), axis=0)
