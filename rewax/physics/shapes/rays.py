"""Where a ray first enters a solid: closed forms of primitives and terrain, sphere tracing of any other distance.

A ray is ``origin + t direction`` with t > 0; directions have any length. Every function returns t, infinite where the
ray misses. Rays begin outside: a solid that holds the origin is not seen, as a renderer that culls back faces.

Differences of large numbers cost float32 its digits: from 5 m away a ball of 1 cm would be known to 0.2 mm. So each
closed form measures t from the point of the ray that is nearest to the solid's axis or centre.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import jax
import jax.numpy as jnp

from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.shapes.grid_cells import take
from rewax.physics.shapes.solid import distance_to
from rewax.types import Array, Scalar

if TYPE_CHECKING:
    from rewax.physics.shapes.base import Shape

TRACE_STEPS = 64
"""Steps of sphere tracing; a ray that grazes a surface for longer misses it."""
_CAUTION = 0.7
"""Share of a distance that is right to first order only by which a ray advances."""
_REFINEMENTS = 2
_TINY = 1e-20


def ball_entry(origin: Vec3, direction: Vec3, radius: Scalar) -> Array:
    """Entry into a ball around the origin [in lengths of direction]."""
    square = cp.dot(direction, direction)
    nearest = -cp.dot(origin, direction) / square
    offset = cp.vector(lambda i: origin[i] + nearest * direction[i])
    chord = (radius * radius - cp.dot(offset, offset)) / square
    return _met(nearest - cp.safe_sqrt(chord), chord > 0)


def slab_interval(origin: Array, direction: Array, half: Scalar) -> tuple[Array, Array]:
    """Where one coordinate lies within [-half, half]: from, to. Empty (from > to) where it never does."""
    slope = jnp.where(jnp.abs(direction) < _TINY, jnp.where(direction < 0, -_TINY, _TINY), direction)
    first, second = (-half - origin) / slope, (half - origin) / slope
    return jnp.minimum(first, second), jnp.maximum(first, second)


def tube_interval(origin: Vec3, direction: Vec3, radius: Scalar) -> tuple[Array, Array]:
    """Where a ray is within a radius of the y axis: from, to. Empty (from > to) where it never is."""
    square = direction[0] * direction[0] + direction[2] * direction[2]
    along_axis = square < _TINY
    square = jnp.where(along_axis, 1.0, square)
    nearest = -(origin[0] * direction[0] + origin[2] * direction[2]) / square
    nearest = jnp.where(along_axis, 0.0, nearest)
    x, z = origin[0] + nearest * direction[0], origin[2] + nearest * direction[2]
    chord = radius * radius - (x * x + z * z)
    half = jnp.where(along_axis, jnp.inf, cp.safe_sqrt(chord / square))
    inside = chord > 0
    return jnp.where(inside, nearest - half, jnp.inf), jnp.where(inside, nearest + half, -jnp.inf)


def common_entry(*intervals: tuple[Array, Array]) -> Array:
    """Entry into the common part of convex solids, each given by the interval of t that lies in it."""
    first = jnp.stack([start for start, _ in intervals]).max(axis=0)
    last = jnp.stack([end for _, end in intervals]).min(axis=0)
    return _met(first, first <= last)


def capsule_entry(origin: Vec3, direction: Vec3, radius: Scalar, half_length: Scalar) -> Array:
    """Entry into all points within a radius of the segment from (0, -half_length, 0) to (0, half_length, 0)."""
    side, _ = tube_interval(origin, direction, radius)
    height = origin[1] + jnp.where(jnp.isfinite(side), side, 0.0) * direction[1]
    ends = [ball_entry((origin[0], origin[1] + y, origin[2]), direction, radius) for y in (half_length, -half_length)]
    t = jnp.minimum(_met(side, jnp.abs(height) <= half_length), jnp.minimum(*ends))
    beyond = jnp.maximum(jnp.abs(origin[1]) - half_length, 0.0)  # of the segment
    # From inside, the ray would enter one of the overlapping balls and tube out of another.
    return jnp.where(origin[0] ** 2 + beyond**2 + origin[2] ** 2 < radius * radius, jnp.inf, t)


def cone_entry(origin: Vec3, direction: Vec3, radius: Scalar, half_length: Scalar) -> Array:
    """Entry into a cone with a base of the radius at y = -half_length and its apex at y = half_length.

    The distance from the axis is ``slope`` times the depth below the apex.
    """
    slope = radius / (2.0 * half_length)
    below, fall = half_length - origin[1], -direction[1]
    a = direction[0] ** 2 + direction[2] ** 2 - (slope * fall) ** 2
    b = origin[0] * direction[0] + origin[2] * direction[2] - slope**2 * fall * below
    c = origin[0] ** 2 + origin[2] ** 2 - (slope * below) ** 2
    square = b * b - a * c
    # The roots are larger / a and c / larger, without cancellation. A ray parallel to the slant has only the second.
    larger = -(b + jnp.where(b < 0, -1.0, 1.0) * cp.safe_sqrt(square))

    def slant(above: Array, divisor: Array) -> Array:
        exists = (square > 0) & (jnp.abs(divisor) > _TINY)
        t = above / jnp.where(exists, divisor, 1.0)
        depth = below + t * fall
        return _met(t, exists & (depth >= 0) & (depth <= 2.0 * half_length))

    t = _met((-half_length - origin[1]) / jnp.where(direction[1] > _TINY, direction[1], _TINY), direction[1] > _TINY)
    finite = jnp.where(jnp.isfinite(t), t, 0.0)
    x, z = origin[0] + finite * direction[0], origin[2] + finite * direction[2]
    base = jnp.where(x * x + z * z <= radius * radius, t, jnp.inf)
    begins_inside = (c < 0) & (below > 0) & (below < 2.0 * half_length)
    return jnp.where(begins_inside, jnp.inf, jnp.minimum(jnp.minimum(slant(larger, a), slant(c, larger)), base))


def plane_entry(origin: Vec3, direction: Vec3) -> Array:
    """Entry into the half-space y < 0."""
    falls = direction[1] < -_TINY
    return _met(origin[1] / jnp.where(falls, -direction[1], 1.0), falls)


def bilinear_entry(
    heights: Array, start: tuple[Scalar, Scalar], spacing: Scalar, origin: Vec3, direction: Vec3
) -> Array:
    """Entry into the ground under heights that are bilinear on a grid and continue beyond its border.

    A ray begins where it falls below the highest node, and goes from cell to cell. Within a cell, its height above the
    ground is a quadratic function of t. The loop ends when each ray has hit, or has left the grid or its heights.

    Args:
      heights: y at the nodes [m], shape (nx, nz).
      start: x and z of node (0, 0) [m].
      spacing: of the nodes [m].
      origin, direction: of the rays, in the frame of the heights.

    Gradient: none.

    Source: Amanatides and Woo 1987, "A fast voxel traversal algorithm for ray tracing".
    """
    heights, start, spacing, origin, direction = jax.lax.stop_gradient((heights, start, spacing, origin, direction))
    nodes, flat = heights.shape, heights.reshape(-1)
    begin = [(origin[2 * k] - start[k]) / spacing for k in range(2)]  # in cells
    speed = [direction[2 * k] / spacing for k in range(2)]
    forward = [speed[k] > 0 for k in range(2)]
    top, falls = jnp.max(heights), direction[1] < 0
    high = origin[1] > top

    def leaves(cell: Array, k: int) -> Array:
        """t at which a ray leaves a cell along one axis, infinite where it never does."""
        ends = jnp.where(forward[k], cell < nodes[k] - 1, cell >= 0) & (jnp.abs(speed[k]) > _TINY)
        border = (cell + forward[k]).astype(begin[k].dtype)
        return jnp.where(ends, (border - begin[k]) / jnp.where(ends, speed[k], 1.0), jnp.inf)

    def above_ground(cells: list[Array], t: Array) -> tuple[Array, Array, Array]:
        """Height above the ground of a cell, as a polynomial of the time after t, the constant last."""
        i, j = ([jnp.clip(cells[k] + end, 0, nodes[k] - 1) for end in (0, 1)] for k in range(2))
        corners = [[take(flat, i[a] * nodes[1] + j[c]) for c in (0, 1)] for a in (0, 1)]
        u, v = (begin[k] + t * speed[k] - cells[k].astype(t.dtype) for k in range(2))
        by_u, by_v = corners[1][0] - corners[0][0], corners[0][1] - corners[0][0]
        by_both = corners[1][1] - corners[0][1] - by_u
        ground = corners[0][0] + by_u * u + by_v * v + by_both * u * v
        rise = by_u * speed[0] + by_v * speed[1] + by_both * (u * speed[1] + v * speed[0])
        return -by_both * speed[0] * speed[1], direction[1] - rise, origin[1] + t * direction[1] - ground

    def follow(carry: _Followed) -> _Followed:
        t, cells, hit, going = carry
        exits = [leaves(cells[k], k) for k in range(2)]
        end = jnp.minimum(*exits)
        met = t + _first_fall(*above_ground(cells, t), end - t)
        hit = jnp.where(going, met, hit)
        going = going & jnp.isinf(met) & jnp.isfinite(end) & (falls | (origin[1] + end * direction[1] <= top))
        steps = [jnp.where(going & (exits[k] <= end), jnp.where(forward[k], 1, -1), 0) for k in range(2)]
        return jnp.where(going, end, t), [cells[k] + steps[k] for k in range(2)], hit, going

    t = jnp.where(high & falls, (top - origin[1]) / jnp.where(falls, direction[1], -1.0), 0.0)
    # Cell -1 lies before the grid, cell n - 1 behind it. The integer is clipped too, so that NaN finds a cell.
    within = [jnp.clip(begin[k] + t * speed[k], -1, nodes[k] - 1) for k in range(2)]
    cells = [jnp.clip(jnp.floor(within[k]).astype(int), -1, nodes[k] - 1) for k in range(2)]
    going = jnp.where(high, falls, above_ground(cells, t)[2] > 0)
    carry = (t, cells, jnp.full_like(t, jnp.inf), going)
    return jax.lax.while_loop(lambda carry: jnp.any(carry[-1]), follow, carry)[2]


_Followed: TypeAlias = tuple[Array, list[Array], Array, Array]
"""t at the entry into a cell, the cell along x and z, t of the hit, and whether a ray still goes on."""


def _first_fall(a: Array, b: Array, c: Array, end: Array) -> Array:
    """The first s in [0, end] from which a s^2 + b s + c is negative; infinite if there is none. 0 if c <= 0."""
    square = b * b - 4.0 * a * c
    # The roots are larger / (2 a) and 2 c / larger, without cancellation.
    larger = -(b + jnp.where(b < 0, -1.0, 1.0) * cp.safe_sqrt(square))

    def root(above: Array, divisor: Array) -> Array:
        exists = (square > 0) & (jnp.abs(divisor) > _TINY)
        s = above / jnp.where(exists, divisor, 1.0)
        return jnp.where(exists & (2.0 * a * s + b <= 0) & (s >= 0) & (s <= end), s, jnp.inf)

    return jnp.where(c <= 0, 0.0, jnp.minimum(root(larger, 2.0 * a), root(2.0 * c, larger)))


def traced_entry(shape: Shape, origin: Vec3, direction: Vec3, start: Array | None = None) -> Array:
    """Entry into any shape by sphere tracing: a ray may advance by the distance to the surface.

    ``TRACE_STEPS`` steps, then two of Newton's along the ray. A surface counts as met within 1e-3 of the distance
    travelled, and the point must lie on a side that faces the ray.

    Args:
      shape: its ``distance`` is exact, or (``is_exact`` False) right to first order.
      origin, direction: of the rays, in the shape's frame.
      start: t at which to begin, shape of the rays; infinite: the ray misses. None: 0.

    Source: Hart 1996, "Sphere tracing".
    """
    length, _ = cp.unit(direction)
    share = (1.0 if shape.is_exact else _CAUTION) / length
    first = jnp.zeros_like(length) if start is None else start
    begin = jnp.where(jnp.isfinite(first), first, 0.0)

    def at(t: Array) -> tuple[Array, Vec3]:
        return distance_to(shape, cp.vector(lambda i: origin[i] + t * direction[i]))

    def advance(_: int, t: Array) -> Array:
        return t + share * jnp.maximum(at(t)[0], 0.0)

    def refine(_: int, t: Array) -> Array:
        distance, normal = at(t)
        approach = -cp.dot(normal, direction)
        return jnp.maximum(t + jnp.where(approach > 0.1 * length, distance / jnp.maximum(approach, _TINY), 0.0), begin)

    outside = at(begin)[0] > 0
    t = jax.lax.fori_loop(0, TRACE_STEPS, advance, begin)
    near = at(t)[0] < 1e-3 * length * (t - begin) + 1e-6
    t = jax.lax.fori_loop(0, _REFINEMENTS, refine, t)
    return _met(t, near & jnp.isfinite(first) & (outside | (begin > 0)))


def _met(t: Array, condition: Array) -> Array:
    return jnp.where(condition & (t > 0), t, jnp.inf)


__all__ = [
    "TRACE_STEPS", "ball_entry", "bilinear_entry", "capsule_entry", "common_entry", "cone_entry", "plane_entry",
    "slab_interval", "traced_entry", "tube_interval",
]  # fmt: skip
