"""Box-box contact as in MuJoCo: up to eight points where two faces meet, or one point where two edges cross."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.rigid.small_products import compose, cross, rotate
from rewax.types import Array

MOST = 8
"""Largest number of corners of the intersection of two rectangles."""
_BIAS, _SAME = 0.95, 0.99
"""Edges meet if they overlap less than faces. If the cosine between both normals is above ``_SAME``, they must overlap
less than ``_BIAS`` times the faces."""
_ALIGNED = 0.01
"""Sine of the angle between two edges. Below it their crossing point has no derivative."""
_TINY = 1e-9
_SIGNS = np.array([(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)])
_ENDS = np.array([(0, 0, 2, 1), (1, 2, 3, 3)])
"""Numbers in ``_SIGNS`` of the corners at both ends of each side."""
_UP = np.array([0.0, 0.0, 1.0])


class _Meeting(NamedTuple):
    """The features of two boxes that meet. Axes are signed one-hot vectors, shape (3,). No derivative."""

    of_second: Array
    """Whether the face is the second box's, shape ()."""
    face: Array
    """Outward axis of the reference face, in the frame of its box."""
    other_face: Array
    """Axis of the other box's face that points most against it."""
    is_edge: Array
    """Whether edges meet instead, shape ()."""
    edge: Array
    """Edge of the first box. Its sign makes the cross product with the second's edge point from first to second."""
    other_edge: Array
    beside: Array
    """Signs of the edge's center in its box, in half sizes; 0 along the edge."""
    other_beside: Array


def box_faces(
    center: Array,
    rotation: Array,
    half_size: Array,
    other_center: Array,
    other_rotation: Array,
    other_half_size: Array,
) -> tuple[Array, Array, Array]:
    """Distances, points and normal of the contacts of two boxes.

    The normal is the axis of least overlap among six faces and nine pairs of edges. Two faces touch at the corners of
    the intersection of their rectangles. Two edges touch at their nearest points.

    Args:
      center, other_center: centers of the first and the second box [m], shape (3,).
      rotation, other_rotation: from each box's frame to the world's, shape (3, 3).
      half_size, other_half_size: half sizes of the boxes [m], shape (3,).

    Returns:
      Signed distances along the normal [m], the smallest first, 1 in unused slots, shape (8,); points
      halfway between the boxes [m], shape (8, 3); unit normal from first to second, shape (3,).

    Gradient: exact while the same features meet. The crossing point of edges within 0.6 degrees of each other is held:
      its derivative grows without bound as they align.
    Source: MuJoCo 4.0: separating axes, and the incident face clipped by the reference face.
    """
    meeting = jax.lax.stop_gradient(
        _meeting(rotation, half_size, other_rotation, other_half_size, other_center - center)
    )
    second = meeting.of_second

    def swapped(a: Array, b: Array) -> tuple[Array, Array]:
        return jnp.where(second, b, a), jnp.where(second, a, b)

    base, guest = swapped(center, other_center)
    axes, guest_axes = swapped(rotation, other_rotation)
    size, guest_size = swapped(half_size, other_half_size)

    # The reference face's frame (two tangents, normal), and in it the center and half sides of the other rectangle.
    first = jnp.roll(jnp.abs(meeting.face), 1)
    along = jnp.stack([first, jnp.roll(first, 1)])
    up = rotate(axes, meeting.face)
    frame = jnp.concatenate([rotate(axes, along), up[None]])
    reach, height = rotate(along, size), jnp.sum(jnp.abs(meeting.face) * size)
    side = jnp.roll(jnp.abs(meeting.other_face), 1)
    sides = rotate(frame, rotate(guest_axes, jnp.stack([side, jnp.roll(side, 1)]) * guest_size))
    lift = jnp.asarray(_UP, height.dtype)
    middle = rotate(frame, guest - base + rotate(guest_axes, meeting.other_face * guest_size)) - lift * height
    point, exists = _common_corners(middle, sides, reach)
    distance = jnp.where(exists, point[:, 2], 1.0)
    nearest = jax.lax.top_k(-distance, MOST)[1]
    chosen = jax.nn.one_hot(nearest, len(distance), dtype=distance.dtype)
    distance, point = jnp.sum(chosen * distance, axis=1), jnp.sum(chosen[:, :, None] * point, axis=1)
    point = base + rotate(frame.T, point + lift * (height - 0.5 * distance[:, None]))

    # Edges: the nearest points of their lines.
    edge, other_edge = rotate(rotation, meeting.edge), rotate(other_rotation, meeting.other_edge)
    skew = cross(edge, other_edge)
    square = jnp.where(meeting.is_edge, jnp.sum(skew * skew), 1.0)
    start = center + rotate(rotation, meeting.beside * half_size)
    gap = other_center + rotate(other_rotation, meeting.other_beside * other_half_size) - start
    normal = skew / jnp.sqrt(square)
    between = jnp.sum(gap * normal)
    met = start + edge * (jnp.sum(cross(gap, other_edge) * skew) / square) + 0.5 * between * normal
    is_first = meeting.is_edge & (np.arange(MOST) == 0)
    distance = jnp.where(meeting.is_edge, jnp.where(is_first, between, 1.0), distance)
    return (
        distance,
        jnp.where(is_first[:, None], met, point),
        jnp.where(meeting.is_edge, normal, jnp.where(second, -up, up)),
    )


def _common_corners(middle: Array, sides: Array, reach: Array) -> tuple[Array, Array]:
    """Corners of the intersection of two rectangles seen from above, at the height of the second; whether each exists.

    Each corner is listed once, also where corners or sides coincide.

    Args:
      middle, sides: center and half sides of the second rectangle, shapes (3,) and (2, 3); z is the height.
      reach: half sides of the first rectangle, which is centered at the origin, shape (2,).
    """
    signs, two = (jnp.asarray(a, reach.dtype) for a in (_SIGNS, [-1.0, 1.0]))
    # Corners of the second inside the first.
    corner = middle + jnp.sum(signs[:, :, None] * sides, axis=1)
    inside = jnp.all(jnp.abs(corner[:, :2]) <= reach, axis=-1)

    # Crossings of the second's sides with the lines of the first's sides: [side, x or y, which of the two lines]. An
    # end on a line does not cross it, because a corner there is inside.
    start = jnp.concatenate([middle - sides, middle + sides])
    way = jnp.concatenate([sides[::-1], sides[::-1]])
    line, run, wall = start[:, :2, None], way[:, :2, None], two * reach[:, None]
    one, other = (corner[ends, :2, None] for ends in _ENDS)
    crosses = ((one < wall) & (other > wall)) | ((one > wall) & (other < wall))
    crosses &= jnp.abs(run) > _TINY * jnp.max(reach)
    share = (wall - line) / jnp.where(crosses, run, 1.0)
    aligned = jnp.abs(run) < _ALIGNED * jnp.sqrt(jnp.sum(run * run, axis=1, keepdims=True))
    share = jnp.where(aligned, jax.lax.stop_gradient(share), share)
    across = line[:, ::-1] + run[:, ::-1] * share
    crosses &= jnp.abs(across) <= reach[::-1, None]
    # A side through a corner of the first crosses a line of x and a line of y at one point, which is listed once.
    apart = jnp.abs(share[:, 0, :, None] - share[:, 1, None, :])
    twice = jnp.any(crosses[:, 0, :, None] & (apart <= 4.0 * jnp.finfo(reach.dtype).eps), axis=1)
    crosses &= ~jnp.stack([jnp.zeros_like(twice), twice], axis=1)
    crossing = start[:, None, None] + share[..., None] * way[:, None, None]

    # Corners of the first inside the second.
    (a, c), (b, d) = sides[:, :2]
    area = a * d - b * c
    lies = jnp.abs(area) > _TINY * jnp.max(reach) ** 2
    area = jnp.where(lies, area, 1.0)
    x, y = (signs * reach - middle[:2]).T
    u, v = (x * d - y * b) / area, (y * a - x * c) / area
    under = middle + u[:, None] * sides[0] + v[:, None] * sides[1]
    lies &= (jnp.abs(u) < 1.0) & (jnp.abs(v) < 1.0)

    point = jnp.concatenate([corner, crossing.reshape(-1, 3), under])
    return point, jnp.concatenate([inside, crosses.reshape(-1), lies])


def _meeting(rotation: Array, half_size: Array, other_rotation: Array, other_half_size: Array, gap: Array) -> _Meeting:
    turn = compose(rotation.T, other_rotation)  # axes of the second, in columns, seen from the first
    near = jnp.abs(turn)
    shift, other_shift = rotate(rotation.T, gap), rotate(other_rotation.T, gap)
    first = half_size + rotate(near, other_half_size) - jnp.abs(shift)
    second = other_half_size + rotate(near.T, half_size) - jnp.abs(other_shift)
    of_second = jnp.min(second) < jnp.min(first)
    towards = jnp.where(shift < 0.0, -1.0, 1.0) * jax.nn.one_hot(jnp.argmin(first), 3)
    back = jnp.where(other_shift < 0.0, 1.0, -1.0) * jax.nn.one_hot(jnp.argmin(second), 3)
    face = jnp.where(of_second, back, towards)
    seen = jnp.where(of_second, rotate(turn, back), rotate(turn.T, towards))
    other_face = -jnp.where(seen < 0.0, -1.0, 1.0) * jax.nn.one_hot(jnp.argmax(jnp.abs(seen)), 3)

    # Common normals of edge i of the first and j of the second, in the first's frame, from first to second.
    normals = jnp.cross(np.eye(3)[:, None, :], turn.T[None, :, :])
    length = jnp.sqrt(jnp.sum(normals * normals, axis=-1))
    outward = jnp.where(jnp.sum(normals * shift, axis=-1) < 0.0, -1.0, 1.0)
    normals = normals * (outward / jnp.maximum(length, _TINY))[..., None]
    seen = jnp.sum(normals[..., :, None] * turn, axis=-2)
    overlap = jnp.sum(jnp.abs(normals) * half_size, axis=-1) + jnp.sum(jnp.abs(seen) * other_half_size, axis=-1)
    overlap = jnp.where(length > _TINY, overlap - jnp.sum(normals * shift, axis=-1), jnp.inf).reshape(-1)
    least = jnp.argmin(overlap)
    i, j = jax.nn.one_hot(least // 3, 3), jax.nn.one_hot(least % 3, 3)

    def chosen(table: Array) -> Array:
        return jnp.sum(table * i[:, None, None] * j[:, None], axis=(0, 1))

    normal, depth = chosen(normals), jnp.minimum(jnp.min(first), jnp.min(second))
    faces_normal = jnp.where(of_second, rotate(turn, back), towards)
    alike = jnp.abs(jnp.sum(normal * faces_normal)) > _SAME
    is_edge = overlap[least] < jnp.where(alike, _BIAS * depth, depth)
    return _Meeting(
        of_second=of_second,
        face=face,
        other_face=other_face,
        is_edge=is_edge,
        edge=i * chosen(outward[..., None]),
        other_edge=j,
        beside=jnp.where(normal < 0.0, -1.0, 1.0) * (1.0 - i),
        other_beside=-jnp.where(chosen(seen) < 0.0, -1.0, 1.0) * (1.0 - j),
    )


__all__ = ["MOST", "box_faces"]
