"""Contact of capsules with planes: both ends, with friction along the capsule and across it."""

import jax
import jax.numpy as jnp

from rewax.physics.rigid.small_products import cross
from rewax.types import Array

_UPRIGHT = 0.1
"""Sine of the angle between axis and normal below which the directions of friction have no derivative."""


def plane_capsule(plane: Array, normal: Array, center: Array, axis: Array, size: Array) -> tuple[Array, Array, Array]:
    """Distances, points and frame of contact of a capsule's two ends with a plane.

    Args:
      plane: a point of the plane [m], shape (3,).
      normal: unit vector out of it, shape (3,).
      center: of the capsule [m], shape (3,).
      axis: unit vector along it, shape (3,).
      size: radius and half the length of the axis [m], shape (2,).

    Returns:
      Signed distances [m], shape (2,); points halfway between surface and plane [m], shape (2, 3); their
      frame, whose rows are the normal, the direction of the axis along the plane and the third, shape (3, 3).

    Gradient: exact, but that the directions of friction are held while the capsule stands within 6 degrees of upright,
      where they turn at once as it tilts.
    Source: MuJoCo's plane and capsule. MJX takes fixed directions within 30 degrees of upright, which turns the pyramid
      of friction.
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
