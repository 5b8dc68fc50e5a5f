"""Plastic creases of cloth: rest angles of hinges that yield.

The elastic angle of a hinge is its angle minus that at rest minus the crease, its plastic part. Where it exceeds the
yield angle, the crease takes up the excess: bending is elastic up to the yield angle and perfectly plastic beyond.
"""

from typing import TYPE_CHECKING

import jax.numpy as jnp

from rewax.lowering.kernels import pointwise
from rewax.physics.numerics.components import Vec3
from rewax.physics.thin import elements
from rewax.physics.thin.elements import Corners
from rewax.physics.thin.stencils import corners
from rewax.physics.thin.unfolded import hinge_sizes
from rewax.types import Array

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene


def yield_angle(scene: "ThinScene") -> Array:
    """Elastic angle at which each hinge yields [rad], shape (num_hinges,): the yield curvature times the hinge's width.

    The width is the area of both triangles over the length of the edge. Gradient: exact.
    """
    assert scene.cloth is not None and scene.cloth.yield_curvature is not None
    edge = hinge_sizes(scene.topology, scene.rest.inverse_edges).length
    return scene.cloth.yield_curvature * edge / scene.rest.hinge_weight


def yielded(scene: "ThinScene", limit: Array, x: Vec3, crease: Array) -> Array:
    """Creases after the return mapping [rad], shape (num_hinges,).

    Args:
      scene: the scene.
      limit: ``yield_angle`` of the scene.
      x: positions [m], components of shape (num_vertices,).
      crease: before [rad].

    Gradient: exact on both sides of the yield angle; that of elasticity at it.
    """
    return _yielded((), (corners(scene.topology.hinges, x), scene.rest.angle, crease, limit))


@pointwise
def _yielded(shared: tuple, given: tuple[Corners, Array, Array, Array]) -> Array:
    del shared
    x, rest, crease, limit = given
    elastic = elements.angle_between(elements.hinge_angle(x), rest + crease)
    return crease + jnp.where(elastic > limit, elastic - limit, jnp.where(elastic < -limit, elastic + limit, 0.0))


def creased(scene: "ThinScene", crease: Array | None) -> "ThinScene":
    """The scene with creases in its rest angles; the scene itself for None. Gradient: exact."""
    if crease is None:
        return scene
    return scene.replace(rest=scene.rest.replace(angle=scene.rest.angle + crease))


__all__ = ["creased", "yield_angle", "yielded"]
