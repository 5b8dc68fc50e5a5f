"""Where a ray first enters a solid: closed forms of the primitives, sphere tracing of any other distance.

A ray is ``origin + t direction`` with t > 0; directions have any length. Every function returns t, infinite where the
ray misses. Rays begin outside: a solid that holds the origin is not seen, as a renderer that culls back faces.

Differences of large numbers cost float32 its digits: from 5 m away a ball of 1 cm would be known to 0.2 mm. So each
closed form measures t from the point of the ray that is nearest to the solid's axis or centre.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
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
    return jnp.minimum(_met(side, jnp.abs(height) <= half_length), jnp.minimum(*ends))


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
    return jnp.minimum(jnp.minimum(slant(larger, a), slant(c, larger)), base)


def plane_entry(origin: Vec3, direction: Vec3) -> Array:
    """Entry into the half-space y < 0."""
    falls = direction[1] < -_TINY
    return _met(origin[1] / jnp.where(falls, -direction[1], 1.0), falls)


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
        return shape.distance(cp.vector(lambda i: origin[i] + t * direction[i]))

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
    "TRACE_STEPS", "ball_entry", "capsule_entry", "common_entry", "cone_entry", "plane_entry", "slab_interval",
    "traced_entry", "tube_interval",
]  # fmt: skip
