"""Bending of cloth: forces, energy and stiffness of a scene's hinges, by either law."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.thin import elements
from rewax.physics.thin.materials import BendingLaw
from rewax.physics.thin.plate import patch, plate_energy, plate_moment, plate_stiffness
from rewax.physics.thin.stencils import corners, gather
from rewax.physics.thin.unfolded import hinge_sizes, unfolded
from rewax.types import Array

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene


def bending_forces(scene: "ThinScene", x: Vec3, v: Vec3) -> Vec3:
    """Forces of bending on the vertices [N], by components. Gradient: exact."""
    hinges, rest, cloth = scene.topology.hinges, scene.rest, scene.cloth
    assert cloth is not None
    damping = jnp.max(cloth.damping)
    if scene.bending_law is BendingLaw.HINGES:
        return elements.hinge_force(cloth.bending, damping, hinges, x, v, rest.angle, rest.hinge_weight)
    turned = elements.hinge_turn(damping, hinges, x, v, rest.angle)
    return elements.hinge_pull(hinges, x, hinge_moments(scene, turned))


def hinge_moments(scene: "ThinScene", turned: Array) -> Array:
    """Derivative of the energy of bending with respect to the angles of hinges [N m], linear in the angles minus those
    at rest [rad], shape (num_hinges,). Gradient: exact."""
    rest, cloth = scene.rest, scene.cloth
    assert cloth is not None
    if scene.bending_law is BendingLaw.HINGES:
        return cloth.bending * rest.hinge_weight * turned
    assert rest.plate is not None
    return plate_moment(cloth.bending, cloth.bending_ratio, rest.plate, patch(scene.topology), turned)


def bending_energy(scene: "ThinScene", x: Vec3) -> Array:
    """Energy of bending [J], shape (). Gradient: exact."""
    rest, cloth = scene.rest, scene.cloth
    assert cloth is not None
    turned = elements.angle_between(elements.hinge_angle(corners(scene.topology.hinges, x)), rest.angle)
    if scene.bending_law is BendingLaw.HINGES:
        return 0.5 * jnp.sum(cloth.bending * rest.hinge_weight * turned**2)
    assert rest.plate is not None
    angle = gather(patch(scene.topology), turned)
    return jnp.sum(plate_energy(cloth.bending, cloth.bending_ratio, rest.plate, angle))


def bending_stiffness(scene: "ThinScene") -> Array:
    """An upper bound of the stiffness of bending at the vertices of a body at rest [N/m], shape (num_vertices,): the
    matrix of these numbers minus the stiffness matrix has no negative eigenvalue. Gradient: exact."""
    hinges, rest, cloth = scene.topology.hinges, scene.rest, scene.cloth
    assert cloth is not None
    angle, pull = jax.vjp(elements.hinge_angle, unfolded(hinge_sizes(scene.topology, rest.inverse_edges)))
    (slopes,) = pull(jnp.ones_like(angle))
    zero = jnp.zeros_like(scene.mass)
    if scene.bending_law is BendingLaw.HINGES:
        each = cloth.bending * rest.hinge_weight * sum(cp.dot(s, s) for s in slopes)
        return zero.at[hinges.indices].add(jnp.broadcast_to(each, angle.shape)[:, None])
    assert rest.plate is not None
    heights = jnp.stack([s[2] for s in slopes], axis=-1)
    return plate_stiffness(cloth.bending, cloth.bending_ratio, rest.plate, scene.topology, heights)


__all__ = ["bending_energy", "bending_forces", "bending_stiffness", "hinge_moments"]
