"""Tendons around spheres and cylinders: where they touch, and the length of the arc.

MJX measures the arc by an arc cosine. Where a tendon begins to touch, that has no finite derivative, and in single
precision rounding decides whether the arc is 0 or a whole turn.
"""

import jax.numpy as jnp
import numpy as np

from rewax.types import Array

_LEAST_ANGLE = {"float32": 1e-4, "float64": 1e-8}
"""Angle of the shortest arc [rad]: what rounding leaves of a smaller one has no sign. Its chord is a straight line."""
_LEAST_TANGENT = 1e-4
"""Shortest tangent from a site to the circle, in radii. The derivative of a shorter one by the site is unbounded."""
_TINY = 1e-15


def wrap(
    start: Array,
    end: Array,
    position: Array,
    rotation: Array,
    radius: Array,
    side: Array,
    has_side: Array,
    is_sphere: Array,
) -> tuple[Array, Array, Array]:
    """Shortest way of a tendon around a sphere, or around a cylinder along its z axis.

    Args:
      start, end: sites before and behind the geom [m], shape (3,).
      position, rotation: pose of the geom, shapes (3,) and (3, 3).
      radius: of the geom [m], shape ().
      side: site on whose side the tendon passes [m], shape (3,); read if ``has_side``, shape ().
      is_sphere: else a cylinder, shape ().

    Returns:
      Length of the arc [m], shape (), -1 where the tendon is straight; its first and its last point [m], shape (3,).

    Gradient: exact, but for arcs and tangents below the least ones, which are straight and constant.

    Source: MuJoCo, ``mju_wrap``.
    """
    p, q, s = (rotation.T @ (point - position) for point in (start, end, side))
    first, second = _plane(p, q)
    first = jnp.where(is_sphere, first, jnp.array([1.0, 0.0, 0.0], p.dtype))
    second = jnp.where(is_sphere, second, jnp.array([0.0, 1.0, 0.0], p.dtype))
    flat_p, flat_q, flat_s = (jnp.stack([first @ point, second @ point]) for point in (p, q, s))
    wraps, angle, touch, tangents = _around_circle(flat_p, flat_q, flat_s, radius, has_side)
    wraps &= (_norm(p) > _TINY) & (_norm(q) > _TINY)

    arc = radius * jnp.where(wraps, angle, 1.0)
    total = tangents[0] + arc + tangents[1]
    rise = q[2] - p[2]
    heights = [p[2] + rise * part / total for part in (tangents[0], tangents[0] + arc)]
    upward = jnp.array([0.0, 0.0, 1.0], p.dtype)
    points = [
        a[0] * first + a[1] * second + jnp.where(is_sphere, 0.0, height) * upward
        for a, height in zip(touch, heights, strict=True)
    ]
    climb = jnp.where(is_sphere, 0.0, rise * arc / total)
    length = jnp.where(wraps, jnp.sqrt(arc * arc + climb * climb), -1.0)
    ends = [jnp.where(wraps, rotation @ point + position, 0.0) for point in points]
    return length, ends[0], ends[1]


def _around_circle(
    p: Array, q: Array, s: Array, radius: Array, has_side: Array
) -> tuple[Array, Array, tuple[Array, Array], list[Array]]:
    """Around a circle at the origin: whether a tendon touches it, the arc's angle, both tangent points and lengths."""
    square = radius * radius
    outside = (p @ p >= square) & (q @ q >= square) & (radius > _TINY)
    safe = [jnp.where(outside, point, at) for point, at in ((p, _beside(radius, p)), (q, -_beside(radius, q)))]
    least = (_LEAST_TANGENT * radius) ** 2
    tangents = [jnp.sqrt(jnp.maximum(point @ point - square, least)) for point in safe]

    way = safe[1] - safe[0]
    apart = way @ way
    nearest = safe[0] + jnp.clip(-(way @ safe[0]) / jnp.maximum(apart, _TINY), 0.0, 1.0) * way
    passes = (nearest @ nearest > square) & (~has_side.astype(bool) | (s @ nearest >= 0))

    shortest, found = _LEAST_ANGLE[p.dtype.name], []
    for sign in (1.0, -1.0):
        a, b = (
            (square * point + turn * radius * tangent * jnp.stack([point[1], -point[0]])) / (point @ point)
            for point, tangent, turn in zip(safe, tangents, (sign, -sign), strict=True)
        )
        middle, chord = a + b, a - b
        worth = jnp.where(has_side.astype(bool), middle @ s / jnp.maximum(_norm(middle), _TINY), -(chord @ chord))
        turned = sign * jnp.arctan2(a[1] * b[0] - a[0] * b[1], a @ b)
        # Both tangents end in one point where the tendon only grazes the circle: rounding must not choose the far side.
        crossed = _cross(safe[0], a, safe[1], b) & (jnp.abs(turned) > 10.0 * shortest)
        found.append((a, b, turned, jnp.where(crossed, -jnp.inf, worth), crossed))
    better = found[0][3] >= found[1][3]
    a, b, turned, _, crossed = (jnp.where(better, x, y) for x, y in zip(*found, strict=True))
    angle = jnp.where(turned < -10.0 * shortest, turned + 2.0 * np.pi, turned)
    wraps = outside & (apart > _TINY) & ~passes & ~crossed & (angle > shortest)
    return wraps, angle, (a, b), tangents


def _plane(p: Array, q: Array) -> tuple[Array, Array]:
    """Two orthogonal unit vectors that span the plane of two points and the origin; any plane for parallel ones."""
    first = p / jnp.maximum(_norm(p), _TINY)
    normal = jnp.cross(p, q)
    size = _norm(normal)
    other = jnp.where(jnp.arange(3) == jnp.argmax(first), 0.0, 1.0).astype(p.dtype)
    other = jnp.cross(first, other)
    normal = jnp.where(size < _TINY, other / jnp.maximum(_norm(other), _TINY), normal / jnp.maximum(size, _TINY))
    second = jnp.cross(normal, first)
    return first, second / jnp.maximum(_norm(second), _TINY)


def _beside(radius: Array, like: Array) -> Array:
    """A point off the circle, in place of one within it."""
    return 2.0 * jnp.maximum(radius, 1.0) * jnp.array([1.0, 0.5], like.dtype)


def _cross(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Whether the lines from a to b and from c to d meet, shape ()."""
    u, v, w = b - a, d - c, a - c
    area = v[1] * u[0] - v[0] * u[1]
    parallel = jnp.abs(area) < _TINY
    share = [(e[0] * w[1] - e[1] * w[0]) / jnp.where(parallel, 1.0, area) for e in (v, u)]
    return ~parallel & (share[0] >= 0) & (share[0] <= 1) & (share[1] >= 0) & (share[1] <= 1)


def _norm(vector: Array) -> Array:
    """Length, with derivative 0 at zero."""
    square = vector @ vector
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


__all__ = ["wrap"]
