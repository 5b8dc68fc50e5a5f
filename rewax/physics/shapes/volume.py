"""Volumes and bounding boxes of shapes."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.shapes.primitives import Box, Capsule, Cone, Cylinder, Ellipsoid, SampledDistance, Shape, Sphere
from rewax.types import Array, Scalar


def volume(shape: Shape) -> Scalar:
    """Volume of a shape [m^3]; particles that fill it stand for volume / num_particles each.

    Args:
      shape: one that is bounded. Of a ``SampledDistance`` it is the volume under zero of the interpolant that is linear
        in six tetrahedra per cell, off by the order of spacing^2.

    Raises:
      ValueError: the shape has no bounds.

    Gradient: exact.
    """
    match shape:
        case Sphere():
            return 4.0 / 3.0 * math.pi * shape.radius**3
        case Capsule():
            return math.pi * shape.radius**2 * (2.0 * shape.half_length + 4.0 / 3.0 * shape.radius)
        case Box():
            return 8.0 * jnp.prod(jnp.asarray(shape.half_size))
        case Cylinder():
            return 2.0 * math.pi * shape.radius**2 * shape.half_length
        case Cone():
            return 2.0 / 3.0 * math.pi * shape.radius**2 * shape.half_length
        case Ellipsoid():
            return 4.0 / 3.0 * math.pi * jnp.prod(jnp.asarray(shape.semi_axes))
        case SampledDistance():
            return _volume_below_zero(jnp.asarray(shape.values)) * shape.spacing**3
    raise ValueError(_unbounded(shape))


def bounding_box(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest coordinates of a shape in its own frame [m], float64 of shape (3,) each.

    Raises:
      ValueError: the shape has no bounds, or a ``SampledDistance`` is nowhere negative.
    """
    match shape:
        case Sphere():
            half = [shape.radius] * 3
        case Capsule():
            half = [shape.radius, shape.half_length + shape.radius, shape.radius]
        case Box():
            half = shape.half_size
        case Cylinder() | Cone():
            half = [shape.radius, shape.half_length, shape.radius]
        case Ellipsoid():
            half = shape.semi_axes
        case SampledDistance():
            return _box_below_zero(shape)
        case _:
            raise ValueError(_unbounded(shape))
    half = np.asarray(half, np.float64)
    return -half, half


def _unbounded(shape: Shape) -> str:
    return f"shape is a {type(shape).__name__}, which has no bounds: use one that has, such as Box"


def _box_below_zero(shape: SampledDistance) -> tuple[np.ndarray, np.ndarray]:
    inside = np.argwhere(np.asarray(shape.values) < 0)
    if len(inside) == 0:
        raise ValueError("SampledDistance.values is nowhere negative, so the shape is empty: bake it with less spacing")
    # The surface is at most one cell beyond the nodes inside.
    nodes = np.clip([inside.min(axis=0) - 1, inside.max(axis=0) + 1], 0, np.array(shape.values.shape) - 1)
    lower, upper = np.asarray(shape.origin, np.float64) + float(shape.spacing) * nodes
    return lower, upper


@jax.jit
def _volume_below_zero(values: Array) -> Array:
    """Volume where the interpolant is negative, in cells."""
    size = [n - 1 for n in values.shape]
    corner: dict[tuple[int, ...], Array] = {
        c: values[c[0] : c[0] + size[0], c[1] : c[1] + size[1], c[2] : c[2] + size[2]]
        for c in itertools.product((0, 1), repeat=3)
    }
    # Corners of each tetrahedron: from 000 to 111, one axis after the other.
    orders = list(itertools.permutations(range(3)))
    tetrahedra = jnp.stack(
        [jnp.stack([corner[tuple(int(a in o[:k]) for a in range(3))] for o in orders]) for k in range(4)]
    )
    return jnp.sum(_fraction_below_zero(jnp.sort(tetrahedra, axis=0))) / 6.0


def _fraction_below_zero(v: Array) -> Array:
    """Part of a tetrahedron in which the linear function with these corner values is negative.

    Args:
      v: values at the corners, ascending along the first axis, shape (4, ...).
    """

    def cut(i: int, j: int) -> Array:
        """How far along the edge from a negative corner i to one that is not, j, the zero is."""
        crosses = (v[i] < 0) & (v[j] >= 0)
        return jnp.where(crosses, v[i] / jnp.where(crosses, v[i] - v[j], 1.0), 0.0)

    one = cut(0, 1) * cut(0, 2) * cut(0, 3)
    a, b, c, d = cut(0, 2), cut(0, 3), cut(1, 2), cut(1, 3)
    two = a * b + a * (1.0 - b) * d + (1.0 - a) * c * d
    three = 1.0 - (1.0 - cut(0, 3)) * (1.0 - cut(1, 3)) * (1.0 - cut(2, 3))
    some = jnp.where(v[2] < 0, three, jnp.where(v[1] < 0, two, one))
    return jnp.where(v[3] <= 0, 1.0, jnp.where(v[0] < 0, some, 0.0))


__all__ = ["bounding_box", "volume"]
