"""Capsule-capsule and sphere-capsule contact."""

import jax.numpy as jnp

from rewax.physics.numerics.clipping import clipped
from rewax.types import Array

_PARALLEL = 1e-6
"""Squared sine of the angle between two axes. Below it their contact moves to the middle of the first capsule."""


def sphere_capsule(
    center: Array, radius: Array, other_center: Array, axis: Array, size: Array
) -> tuple[Array, Array, Array]:
    """Distances, points and normals of contact of spheres with capsules, n pairs.

    Args:
      center, radius: centers and radii of the spheres [m], shapes (n, 3) and (n,).
      other_center: centers of the capsules [m], shape (n, 3).
      axis: unit vectors along the capsules, shape (n, 3).
      size: radii and half lengths of the axes of the capsules [m], shape (n, 2).

    Returns:
      Distances, points and normals as ``capsule_capsule`` returns them; normals point from sphere to capsule.

    Gradient: exact, finite everywhere. Where the sphere's centre lies on the axis the normal is zero.
    """
    offset = clipped(jnp.sum((center - other_center) * axis, axis=-1), -size[..., 1], size[..., 1])
    return _spheres(center, radius, other_center + offset[..., None] * axis, size[..., 0])


def capsule_capsule(
    center: Array,
    axis: Array,
    size: Array,
    other_center: Array,
    other_axis: Array,
    other_size: Array,
    *,
    parallel: float = _PARALLEL,
) -> tuple[Array, Array, Array]:
    """Distances, points and normals of contact of two capsules, n pairs.

    Args:
      center, other_center: centers of the first and the second capsules [m], shape (n, 3).
      axis, other_axis: unit vectors along the capsules, shape (n, 3).
      size, other_size: radius and half the length of the axis [m], shape (n, 2).
      parallel: squared sine of the angle between two axes, below which their contact moves to the middle of the first
        capsule. A smaller value is closer to MuJoCo, but gives larger derivatives to almost parallel capsules.

    Returns:
      Signed distances between the surfaces [m], shape (n,); points halfway between them [m], shape (n, 3); unit
      normals from first to second, shape (n, 3).

    Gradient: exact, finite everywhere. Where the axes cross the normal is zero.
    Source: Ericson 2005, Real-Time Collision Detection, section 5.1.9. MuJoCo gives parallel capsules a second contact.
    """
    length, other_length = size[..., 1], other_size[..., 1]
    gap = other_center - center
    cosine = jnp.sum(axis * other_axis, axis=-1)
    along, other_along = jnp.sum(axis * gap, axis=-1), jnp.sum(other_axis * gap, axis=-1)
    # Offsets along the axes from the centers: first as if the second axis were endless, then each from the other.
    offset = (along - cosine * other_along) / (1.0 - cosine * cosine + parallel)
    offset = clipped(offset, -length, length)
    other_offset = clipped(cosine * offset - other_along, -other_length, other_length)
    offset = clipped(cosine * other_offset + along, -length, length)
    nearest = center + offset[..., None] * axis
    return _spheres(nearest, size[..., 0], other_center + other_offset[..., None] * other_axis, other_size[..., 0])


def _spheres(center: Array, radius: Array, other_center: Array, other_radius: Array) -> tuple[Array, Array, Array]:
    across = other_center - center
    square = jnp.sum(across * across, axis=-1)
    apart = square > 0.0
    between = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)
    normal = across / jnp.where(apart, between, 1.0)[..., None]
    distance = between - radius - other_radius
    return distance, center + normal * (radius + 0.5 * distance)[..., None], normal


__all__ = ["capsule_capsule", "sphere_capsule"]
