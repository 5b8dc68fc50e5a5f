"""Capsule-box contact as in MuJoCo: at the nearest point, and at a second point if the capsule lies on the box."""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.rigid.small_products import rotate
from rewax.physics.rigid.sphere_box import sphere_box
from rewax.types import Array

_ALIGNED = 1e-4
"""Squared sine of the angle between capsule and edge. Below it the nearest point has no derivative."""
_BEYOND = 4.0
"""A distance in half lengths of a capsule that is beyond both of its ends."""
_EDGES = np.repeat(np.eye(3), 4, axis=0)
_CORNERS = np.array([np.insert(s, j, 0.0) for j in range(3) for s in itertools.product((-1.0, 1.0), repeat=2)])
"""Axis of each edge of a box, one-hot, and the edge's center in half sizes."""
_TINY = 1e-12


class _Nearest(NamedTuple):
    """The point of a capsule's axis that is nearest to a box, and the nearest feature of the box."""

    offset: Array
    """Signed distance of the point from the capsule's center, in half lengths of the capsule, shape ()."""
    is_end: Array
    """Whether the point is an end of the capsule over a face or inside the box, shape ()."""
    face: Array
    """Axis of that face, one-hot, zero inside the box, shape (3,)."""
    edge: Array
    """Axis of the nearest edge if the point is no such end, one-hot, shape (3,)."""
    along: Array
    """Position on that edge in half lengths of the edge, shape ()."""
    corner: Array
    """Signs of the corner at the near end of the edge; of its lower end if the nearest point is inside the edge."""
    is_corner: Array
    """Whether that corner is the nearest feature, shape ()."""


def capsule_box(
    center: Array, axis: Array, size: Array, box: Array, rotation: Array, half_size: Array
) -> tuple[Array, Array, Array]:
    """Distances, points and normals of the two contacts of a capsule with a box.

    Args:
      center: center of the capsule [m], shape (3,).
      axis: unit vector along the capsule, shape (3,).
      size: radius and half the length of the axis [m], shape (2,).
      box: centre of the box [m], shape (3,).
      rotation: from the box's frame to the world's, shape (3, 3).
      half_size: half sizes of the box [m], shape (3,).

    Returns:
      Signed distances [m], 1 if there is no second contact, shape (2,); points halfway between the surfaces
      [m], shape (2, 3); unit normals from capsule to box, shape (2, 3).

    Gradient: exact while the same features are nearest. The nearest point of a capsule and an edge is held while they
      are within 0.6 degrees of parallel: its derivative grows without bound as they align.
    Source: MuJoCo's engine_collision_box.c, capsule with box.
    """
    middle, half = rotate(rotation.T, center - box), rotate(rotation.T, axis) * size[1]
    nearest = _nearest(middle, half, half_size)
    second, exists = _second(nearest, middle, half, half_size)
    offsets = jnp.stack([nearest.offset, nearest.offset + second])
    spheres = center + offsets[:, None] * axis * size[1]

    def twice(a: Array) -> Array:
        return jnp.stack([a, a])

    distance, point, normal = sphere_box(spheres, twice(size[0]), twice(box), twice(rotation), twice(half_size))
    return jnp.where(jnp.stack([jnp.array(True), exists]), distance, 1.0), point, normal


def _nearest(middle: Array, half: Array, size: Array) -> _Nearest:
    """Nearest features, in the box's frame, of a capsule from ``middle - half`` to ``middle + half``."""
    edges, corners, two = (jnp.asarray(a, half.dtype) for a in (_EDGES, _CORNERS, [[-1.0], [1.0]]))
    ends = middle + two * half
    beyond = ends - jnp.clip(ends, -size, size)
    outside = beyond != 0.0
    end_distance = jnp.where(jnp.sum(outside, axis=1) > 1, jnp.inf, jnp.sum(beyond * beyond, axis=1))

    # Nearest points of the capsule's axis and of all edges, each in half lengths.
    reach, gap = jnp.sum(edges * size, axis=1), corners * size - middle
    a, b, c = reach * reach, -reach * jnp.sum(edges * half, axis=1), jnp.sum(half * half)
    u, v = -reach * jnp.sum(edges * gap, axis=1), jnp.sum(half * gap, axis=1)
    area = a * c - b * b
    crosses = area > _TINY * a * c
    area = jnp.where(crosses, area, 1.0)
    edge_offset, offset = (c * u - b * v) / area, (a * v - b * u) / area
    tip = jnp.where(jnp.abs(edge_offset) > 1.0, jnp.sign(edge_offset), 0.0)
    past = tip != 0.0
    edge_offset = jnp.clip(edge_offset, -1.0, 1.0)
    length = jnp.maximum(c, _TINY)
    offset = jnp.where(past, (v - b * edge_offset) / length, offset)
    over = jnp.abs(offset) > 1.0
    offset = jnp.clip(offset, -1.0, 1.0)
    again = (u - b * offset) / a
    tip = jnp.where(over & (jnp.abs(again) > 1.0), jnp.sign(again), tip)  # MuJoCo keeps the tip from before the clip
    edge_offset = jnp.where(over, jnp.clip(again, -1.0, 1.0), edge_offset)
    held = area < _ALIGNED * a * c
    offset, edge_offset = (jnp.where(held, jax.lax.stop_gradient(x), x) for x in (offset, edge_offset))
    apart = gap - offset[:, None] * half + (edge_offset * reach)[:, None] * edges
    edge_distance = jnp.where(crosses, jnp.sum(apart * apart, axis=1), jnp.inf)

    end, edge = jnp.argmin(end_distance), jnp.argmin(edge_distance)
    is_end = ~(edge_distance[edge] < end_distance[end])
    chosen = jax.nn.one_hot(edge, 12, dtype=middle.dtype)
    near_tip = jnp.sum(chosen * tip)
    edge_axis = jnp.sum(chosen[:, None] * edges, axis=0)
    upper = jnp.where(near_tip > 0.0, 1.0, -1.0)
    return _Nearest(
        offset=jnp.where(is_end, jnp.where(end == 0, -1.0, 1.0), jnp.sum(chosen * offset)),
        is_end=is_end,
        face=jnp.where(end == 0, outside[0], outside[1]).astype(middle.dtype),
        edge=edge_axis,
        along=jnp.sum(chosen * edge_offset),
        corner=jnp.sum(chosen[:, None] * corners, axis=0) + edge_axis * upper,
        is_corner=near_tip != 0.0,
    )


def _second(nearest: _Nearest, middle: Array, half: Array, size: Array) -> tuple[Array, Array]:
    """Signed distance along the capsule from the first contact to the second; whether there is a second, shape () each.

    From an end over a face, the second contact is at the other end or at the face's rim. From a corner, it lies along
    the edge or the face to which the capsule is more nearly parallel. From an edge, it lies across the more nearly
    parallel of the two faces.
    """
    offset, reach = nearest.offset, jnp.abs(half)
    has_reach = reach > _TINY
    reach = jnp.where(has_reach, reach, 1.0)
    wide = jnp.where(has_reach, 2.0 * size / reach, _BEYOND)
    inward = -jnp.sign(offset)

    # From an end over a face.
    end = middle + offset * half
    way = jnp.where(has_reach, (jnp.where(half * inward > 0, size, -size) - end) / jnp.where(has_reach, half, 1.0), 9.0)
    way = jnp.where(nearest.face > 0, _BEYOND, way * inward)
    from_end = jnp.minimum(2.0, jnp.min(jnp.where(way > 0, way, _BEYOND))) * inward
    over_face = jnp.any(nearest.face > 0)

    # Axes along which the capsule points away from the corner or towards it, as seen from its own direction. Along an
    # axis at right angles to it, it points as fits the direction in which it goes most.
    points_away = (half > 0) != (nearest.corner > 0)

    def completed(main: Array) -> Array:
        return jnp.where(has_reach, points_away, ~jnp.any(points_away & (main > 0)))

    # From a corner.
    differs = completed(jax.nn.one_hot(jnp.argmax(jnp.abs(half)), 3))
    count = jnp.sum(differs)
    forward = jnp.where(count == 1, 1.0, -1.0)
    single = jnp.where(count == 1, differs, ~differs)
    along_edge = jnp.sum(single * half * half) > 0.5 * jnp.sum(half * half)
    edge_way = jnp.minimum(1.0 - forward * offset, jnp.min(jnp.where(single, wide, _BEYOND))) * forward
    face_way = -jnp.minimum(1.0 + forward * offset, jnp.min(jnp.where(single, _BEYOND, wide))) * forward
    from_corner = jnp.where(along_edge, edge_way, face_way)
    at_corner = (count == 1) | (count == 2)

    # From an edge, across the face along which the capsule goes more.
    across = jnp.where(nearest.edge > 0, -1.0, jnp.abs(half))
    main = jax.nn.one_hot(jnp.argmax(across), 3, dtype=half.dtype)
    sides = completed(main) & (nearest.edge == 0)
    ahead = jnp.any(sides & (main > 0))
    forward = jnp.where(ahead, 1.0, -1.0)
    same = jnp.any((half > 0) & (nearest.edge > 0)) == ahead
    rest = 1.0 - jnp.where(same, 1.0, -1.0) * nearest.along
    limits = jnp.where(main > 0, wide, jnp.where(nearest.edge > 0, 0.5 * wide * rest, _BEYOND))
    from_edge = jnp.minimum(1.0 - forward * offset, jnp.min(limits)) * forward

    way = jnp.where(nearest.is_corner, from_corner, from_edge)
    exists = jnp.where(nearest.is_corner, at_corner, jnp.sum(sides) == 1)
    return jnp.where(nearest.is_end, from_end, way), jnp.where(nearest.is_end, over_face, exists)


__all__ = ["capsule_box"]
