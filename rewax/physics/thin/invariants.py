"""Conserved quantities of cloth and ropes: energy and momentum."""

import jax.numpy as jnp

from rewax.physics.numerics import components as cp
from rewax.physics.thin import elements
from rewax.physics.thin.bending import bending_energy
from rewax.physics.thin.creases import creased
from rewax.physics.thin.scene import ThinScene, ThinState, check_vertices
from rewax.physics.thin.stencils import corners
from rewax.physics.thin.stepping import inverse_edges
from rewax.types import Array


def elastic_energy(scene: ThinScene, state: ThinState) -> Array:
    """Elastic energy [J], shape (); zero at rest. Gradient: exact."""
    check_vertices(scene, state)
    x = cp.split_vector(state.x)
    scene = creased(scene, state.crease)
    topology, rest = scene.topology, scene.rest
    energy = jnp.zeros((), state.x.dtype)
    if scene.cloth is not None:
        strain = elements.green_strain(corners(topology.triangles, x), inverse_edges(scene))
        energy += jnp.sum(rest.area * elements.membrane_energy(strain, scene.cloth, scene.law))
        if len(topology.hinges):
            energy += bending_energy(scene, x)
    if scene.rope is not None:
        stretch = elements.segment_strain(corners(topology.segments, x), rest.length)
        energy += 0.5 * jnp.sum(scene.rope.stretch * rest.length * stretch**2)
        curvature = elements.half_square_curvature(corners(topology.bends, x))
        energy += jnp.sum(scene.rope.bending * curvature / rest.bend_length)
    return energy


def kinetic_energy(scene: ThinScene, state: ThinState) -> Array:
    """Kinetic energy [J], shape (): sum m/2 |v|^2. Gradient: exact."""
    return 0.5 * jnp.sum(scene.mass * jnp.sum(state.v**2, axis=-1))


def gravitational_energy(scene: ThinScene, state: ThinState) -> Array:
    """Potential energy in the scene's gravity [J], shape (): -sum m g . x. Gradient: exact."""
    return -jnp.sum(scene.mass * jnp.sum(scene.gravity * state.x, axis=-1))


def momentum(scene: ThinScene, state: ThinState) -> Array:
    """Linear momentum [kg m/s], shape (3,). Gradient: exact.

    It is constant without gravity, drag, ground, colliders, grasps and held vertices.
    """
    return jnp.sum(scene.mass[:, None] * state.v, axis=0)


def angular_momentum(scene: ThinScene, state: ThinState) -> Array:
    """Angular momentum about the origin [kg m^2/s], shape (3,). Gradient: exact.

    With explicit steps it is constant under the conditions of ``momentum``, if self-contact has no friction. Implicit
    Euler changes it at a rate proportional to dt.
    """
    return jnp.sum(scene.mass[:, None] * jnp.cross(state.x, state.v), axis=0)


__all__ = ["angular_momentum", "elastic_energy", "gravitational_energy", "kinetic_energy", "momentum"]
