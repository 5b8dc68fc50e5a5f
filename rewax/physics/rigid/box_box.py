"""Box-box contact with one contact per pair, on the axis of least overlap (separating axis theorem)."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.types import Array

_FLAT = 0.1
"""Sine of a tilt. Below it the contact of two faces, or of a face and an edge, lies between the corners."""
_SKEW = 0.03
"""Squared sine of the angle between two edges. Below it their common normal fades out."""
_ROUNDS = 3
"""Number of projections that look for a point inside both boxes."""


def box_box(
    center: Array,
    rotation: Array,
    half_size: Array,
    other_center: Array,
    other_rotation: Array,
    other_half_size: Array,
) -> tuple[Array, Array, Array]:
    """Distances, points and normals of contact of two boxes, n pairs.

    Two boxes overlap if they overlap along the normals of their faces (6) and the common normals of their edges (9).
    This finds corners in faces and crossing edges. The axis of least overlap gives distance and normal. The contact
    lies in the middle of parallel faces and moves to the deepest corner as they tilt, so a flat box lies flat. One
    contact does not damp rocking.

    Args:
      center, other_center: centers of the first and second boxes [m], shape (n, 3).
      rotation, other_rotation: from each box's frame to the world's, shape (n, 3, 3).
      half_size, other_half_size: half sizes of the boxes [m], shape (n, 3).

    Returns:
      Signed distances along these axes [m], shape (n,): minus the depth if the boxes overlap, else a lower bound of the
      distance; points of contact [m], shape (n, 3); unit normals from first to second, shape (n, 3).

    Gradient: exact, finite everywhere. Where two axes have the same overlap the normal jumps, the distance does not.
    Source: Gottschalk, Lin and Manocha 1996, OBBTree. Common normals of edges within 10 degrees of each other fade out.
    """
    axes, others = jnp.swapaxes(rotation, 1, 2), jnp.swapaxes(other_rotation, 1, 2)
    gap = other_center - center
    face, other_face, edge, other_edge = jax.lax.stop_gradient(
        _least_overlap(axes, half_size, others, other_half_size, gap)
    )
    # The chosen axis again, with derivatives.
    along, across = _row(edge, axes), _row(other_edge, others)
    skew = jnp.cross(along, across)
    square = jnp.sum(skew * skew, axis=-1)
    is_skew = jnp.any(edge > 0, axis=-1)
    length = jnp.sqrt(jnp.where(is_skew, square, 1.0))
    normal = (_row(face, axes) + _row(other_face, others) + skew) / length[:, None]
    normal = normal * jnp.where(jnp.sum(normal * gap, axis=-1) < 0.0, -1.0, 1.0)[:, None]
    tilt = jnp.sum(axes * normal[:, None, :], axis=-1)
    other_tilt = jnp.sum(others * normal[:, None, :], axis=-1)
    distance = jnp.sum(normal * gap, axis=-1)
    distance -= jnp.sum(half_size * jnp.abs(tilt), axis=-1) + jnp.sum(other_half_size * jnp.abs(other_tilt), axis=-1)
    distance -= jnp.where(is_skew, _fade(square), 0.0) * jnp.min(half_size, axis=-1)
    # Start from the foremost point of each box and project it into both.
    first = center + _row(half_size * jnp.clip(tilt / _FLAT, -1.0, 1.0), axes)
    second = other_center - _row(other_half_size * jnp.clip(other_tilt / _FLAT, -1.0, 1.0), others)
    for _ in range(_ROUNDS):
        first = _nearest(center, axes, half_size, _nearest(other_center, others, other_half_size, first))
        second = _nearest(other_center, others, other_half_size, _nearest(center, axes, half_size, second))
    return distance, 0.5 * (first + second), normal


def _least_overlap(
    axes: Array, half_size: Array, others: Array, other_half_size: Array, gap: Array
) -> tuple[Array, Array, Array, Array]:
    """One-hot axes of least overlap, shape (n, 3) each: face of the first box, of the second, edges of both."""
    turn = jnp.sum(axes[:, :, None, :] * others[:, None, :, :], axis=-1)  # cosines between axes
    near = jnp.abs(turn)
    shift, other_shift = jnp.sum(axes * gap[:, None, :], axis=-1), jnp.sum(others * gap[:, None, :], axis=-1)
    faces = jnp.abs(shift) - half_size - jnp.sum(near * other_half_size[:, None, :], axis=-1)
    other_faces = jnp.abs(other_shift) - other_half_size - jnp.sum(near * half_size[:, :, None], axis=-2)
    # Edge i of the first box and edge j of the second: project the other axes of each on the common normal.
    after, last = np.array([1, 2, 0]), np.array([2, 0, 1])
    square = jnp.maximum(1.0 - turn * turn, 1e-6)
    between = jnp.abs(shift[:, last, None] * turn[:, after] - shift[:, after, None] * turn[:, last])
    reach = half_size[:, after, None] * near[:, last] + half_size[:, last, None] * near[:, after]
    reach += other_half_size[:, None, after] * near[:, :, last] + other_half_size[:, None, last] * near[:, :, after]
    edges = (between - reach) / jnp.sqrt(square) - _fade(square) * jnp.min(half_size, axis=-1)[:, None, None]
    all_axes = jnp.concatenate([faces, other_faces, edges.reshape(-1, 9)], axis=-1)
    chosen = jax.nn.one_hot(jnp.argmax(all_axes, axis=-1), 15, dtype=gap.dtype)
    pair = chosen[:, 6:].reshape(-1, 3, 3)
    return chosen[:, :3], chosen[:, 3:6], jnp.sum(pair, axis=2), jnp.sum(pair, axis=1)


def _fade(square: Array) -> Array:
    """Penalty on the common normal of nearly parallel edges, in half sizes; it grows without bound as they align."""
    return jnp.maximum(_SKEW / jnp.maximum(square, 1e-6) - 1.0, 0.0)


def _row(weight: Array, axes: Array) -> Array:
    return jnp.sum(weight[:, :, None] * axes, axis=1)


def _nearest(center: Array, axes: Array, half_size: Array, point: Array) -> Array:
    """Points of the boxes that are nearest to the given points, shape (n, 3)."""
    local = jnp.sum(axes * (point - center)[:, None, :], axis=-1)
    return center + _row(jnp.clip(local, -half_size, half_size), axes)


__all__ = ["box_box"]
