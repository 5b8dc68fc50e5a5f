"""Shapes as a user writes them."""

import jax.numpy as jnp

from rewax import struct
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import POSITIVE
from rewax.physics.shapes import Shape
from rewax.types import Scalar


@struct.dataclass
class Torus(Shape):
    """A ring around y: all points within ``tube`` of the circle of radius ``ring`` [m]."""

    ring: Scalar = struct.number(POSITIVE, "give a length in metres")
    tube: Scalar = struct.number(POSITIVE, "give a length in metres")
    has_edges = False

    def distance(self, p):
        from_axis, (x, _, z) = cp.unit((p[0], jnp.zeros_like(p[1]), p[2]))
        from_circle, (outwards, up, _) = cp.unit((from_axis - self.ring, p[1], jnp.zeros_like(p[1])))
        return from_circle - self.tube, (outwards * x, up, outwards * z)

    def bounding_box(self):
        reach = self.ring + self.tube
        half = jnp.stack([reach, self.tube, reach])
        return -half, half


@struct.dataclass
class Union(Shape):
    """Two shapes: inside of one or the other."""

    first: Shape
    second: Shape
    is_exact = False

    def distance(self, p):
        (d, n), (e, m) = self.first.distance(p), self.second.distance(p)
        return jnp.minimum(d, e), cp.vector(lambda i: jnp.where(d < e, n[i], m[i]))

    def bounding_box(self):
        (low, high), (lower, upper) = self.first.bounding_box(), self.second.bounding_box()
        return jnp.minimum(low, lower), jnp.maximum(high, upper)
