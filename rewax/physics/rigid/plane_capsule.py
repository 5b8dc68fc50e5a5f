"""Plane-capsule contact at both ends, with friction directions along the capsule and across it."""

import jax
import jax.numpy as jnp

from rewax.physics.rigid.small_products import cross
from rewax.types import Array

_UPRIGHT = 0.1
"""Sine of the angle between axis and normal. Below it the directions of friction have no derivative."""


def plane_capsule(plane: Array, normal: Array, center: Array, axis: Array, size: Array) -> tuple[Array, Array, Array]:
    """Distances, points and frame of contact of a capsule's two ends with a plane.

    Args:
      plane: a point of the plane [m], shape (3,).
      normal: unit normal out of the plane, shape (3,).
      center: center of the capsule [m], shape (3,).
      axis: unit vector along the capsule, shape (3,).
      size: radius and half length of the axis [m], shape (2,).

    Returns:
      Signed distances [m], shape (2,); points halfway between surface and plane [m], shape (2, 3); their
      common frame with rows normal, direction of the axis in the plane, and their cross product, shape (3, 3).

    Gradient: exact, except that the directions of friction are held within 6 degrees of upright, where a small tilt
      rotates them by a large angle.
    Source: MuJoCo's plane-capsule collision. MJX uses fixed directions within 30 degrees of upright, which rotates the
      friction pyramid.
    """
    lean = axis - normal * jnp.sum(axis * normal)
    square = jnp.sum(lean * lean)
    leans = square > 1e-20
    along = jnp.where(leans, lean, jnp.array([1.0, 0.0, 0.0], lean.dtype)) / jnp.sqrt(jnp.where(leans, square, 1.0))
    along = jnp.where(square > _UPRIGHT**2, along, jax.lax.stop_gradient(along))
    end = center + jnp.array([[1.0], [-1.0]]) * axis * size[1]
    distance = jnp.sum((end - plane) * normal, axis=-1) - size[0]
    point = end - normal * (size[0] + 0.5 * distance[:, None])
    return distance, point, jnp.stack([normal, along, cross(normal, along)])


__all__ = ["plane_capsule"]
