"""Contact of capsules with each other and with spheres."""

import jax.numpy as jnp

from rewax.types import Array

_PARALLEL = 1e-6
"""Square of the sine of the angle between two axes below which their contact moves to the middle of the first."""


def sphere_capsule(
    center: Array, radius: Array, other_center: Array, axis: Array, size: Array
) -> tuple[Array, Array, Array]:
    """Distances, points and normals of contact of spheres with capsules, n pairs.

    Args:
      center, radius: of the spheres [m], shapes (n, 3) and (n,).
      other_center, axis: of the capsules [m], and unit vectors along them, shape (n, 3).
      size: of the capsules, radius and half the length of the axis [m], shape (n, 2).

    Returns:
      As of ``capsule_capsule``, normals from sphere to capsule.

    Gradient: exact, finite everywhere. Where the sphere's centre lies on the axis the normal is zero.
    """
    place = jnp.clip(jnp.sum((center - other_center) * axis, axis=-1), -size[..., 1], size[..., 1])
    return _spheres(center, radius, other_center + place[..., None] * axis, size[..., 0])


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
      center, other_center: of the first and the second capsules [m], shape (n, 3).
      axis, other_axis: unit vectors along them, shape (n, 3).
      size, other_size: radius and half the length of the axis [m], shape (n, 2).
      parallel: square of the sine of the angle between two axes below which their contact moves to the middle of the
        first. The smaller, the closer to MuJoCo's, and the larger the derivatives of capsules that are almost parallel.

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
    # Places along the axes, from the centres: on the first as if the second were endless, then each by the other.
    place = (along - cosine * other_along) / (1.0 - cosine * cosine + parallel)
    place = jnp.clip(place, -length, length)
    other_place = jnp.clip(cosine * place - other_along, -other_length, other_length)
    place = jnp.clip(cosine * other_place + along, -length, length)
    nearest = center + place[..., None] * axis
    return _spheres(nearest, size[..., 0], other_center + other_place[..., None] * other_axis, other_size[..., 0])


def _spheres(center: Array, radius: Array, other_center: Array, other_radius: Array) -> tuple[Array, Array, Array]:
    across = other_center - center
    square = jnp.sum(across * across, axis=-1)
    apart = square > 0.0
    between = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)
    normal = across / jnp.where(apart, between, 1.0)[..., None]
    distance = between - radius - other_radius
    return distance, center + normal * (radius + 0.5 * distance)[..., None], normal


__all__ = ["capsule_capsule", "sphere_capsule"]
