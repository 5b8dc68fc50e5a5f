"""Closest points of a vertex and a triangle, and of two segments, by components. Gradient: exact."""

import jax.numpy as jnp

from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.types import Array

Weights = tuple[Array, Array, Array, Array]
"""Weights w of four corners x. The sum of w x is the vector between the closest points; the sum of w is 0."""


def vertex_triangle(x: tuple[Vec3, ...]) -> Weights:
    """Weights for a vertex x[0] and a triangle x[1:]: 1 and minus the barycentric coordinates of the closest point.

    The closest point of a triangle is unique and moves continuously with the corners. Gradient: exact; it jumps where
    the closest point leaves the inside or an edge.
    """
    p, a, b, c = x
    first, second, toward = cp.subtract(b, a), cp.subtract(c, a), cp.subtract(p, a)
    f, g, h = cp.dot(first, first), cp.dot(first, second), cp.dot(second, second)
    d, e = cp.dot(first, toward), cp.dot(second, toward)
    det = jnp.maximum(f * h - g * g, 1e-12 * f * h)
    inner = ((h * d - g * e) / det, (f * e - g * d) / det)
    inside = (inner[0] >= 0) & (inner[1] >= 0) & (inner[0] + inner[1] <= 1)
    # On the edges ab, ac and bc: t along each of them.
    t_ab, t_ac = jnp.clip(d / f, 0.0, 1.0), jnp.clip(e / h, 0.0, 1.0)
    t_bc = jnp.clip((f - g - d + e) / (f - 2.0 * g + h), 0.0, 1.0)
    zero = jnp.zeros_like(d)
    best_u, best_v = t_ab, zero
    best = _square(f, g, h, d, e, t_ab, zero)
    for u, v in ((zero, t_ac), (1.0 - t_bc, t_bc)):
        other = _square(f, g, h, d, e, u, v)
        nearer = other < best
        best_u, best_v, best = (jnp.where(nearer, new, old) for new, old in ((u, best_u), (v, best_v), (other, best)))
    u, v = jnp.where(inside, inner[0], best_u), jnp.where(inside, inner[1], best_v)
    return jnp.ones_like(u), u + v - 1.0, -u, -v


def _square(f: Array, g: Array, h: Array, d: Array, e: Array, u: Array, v: Array) -> Array:
    """|p - a - u first - v second|^2 - |p - a|^2."""
    return f * u * u + 2.0 * g * u * v + h * v * v - 2.0 * (d * u + e * v)


def segments(x: tuple[Vec3, ...], smoothing: Array) -> Weights:
    """Weights for the segments x[:2] and x[2:]: 1 - s, s, t - 1, -t.

    Here s and t in [0, 1] minimize |difference|^2 + smoothing^2 ((2 s - 1)^2 + (2 t - 1)^2). The second term [m^2]
    draws the points to the middles of the segments, so that they are unique for parallel segments too. Gradient: exact.
    """
    first, second, between = cp.subtract(x[1], x[0]), cp.subtract(x[3], x[2]), cp.subtract(x[2], x[0])
    extra = 2.0 * smoothing * smoothing
    a, b, c = cp.dot(first, first) + 2.0 * extra, cp.dot(first, second), cp.dot(second, second) + 2.0 * extra
    p, q = cp.dot(first, between) + extra, extra - cp.dot(second, between)
    # Exact for a convex square function on a square: minimize over s, then t, then s again.
    s = jnp.clip((c * p + b * q) / (a * c - b * b), 0.0, 1.0)
    t = jnp.clip((q + b * s) / c, 0.0, 1.0)
    s = jnp.clip((p + b * t) / a, 0.0, 1.0)
    return 1.0 - s, s, t - 1.0, -t


def weighted(weights: Weights, x: tuple[Vec3, ...]) -> Vec3:
    """Sum of w x over the corners."""
    return cp.vector(lambda i: sum(w * corner[i] for w, corner in zip(weights, x, strict=True)))


__all__ = ["Weights", "segments", "vertex_triangle", "weighted"]
