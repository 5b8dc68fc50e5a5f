"""Balls and capsules: the points within a radius of a point or of a segment."""

import math

import jax.numpy as jnp

from rewax import struct
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import NOT_NEGATIVE, POSITIVE
from rewax.physics.numerics.clipping import clipped
from rewax.physics.numerics.components import Vec3
from rewax.physics.shapes.base import Shape, around_origin, inverse_distance
from rewax.physics.shapes.drawn import ORIGIN, UPRIGHT, Drawing
from rewax.physics.shapes.rays import ball_entry, capsule_entry
from rewax.physics.shapes.revolved import cylinder_inertia
from rewax.types import Array, Scalar


@struct.dataclass
class Sphere(Shape):
    """A ball around the origin. ``radius`` [m]."""

    radius: Scalar = struct.number(POSITIVE, "give a length in metres", shape=())
    has_edges = False

    def distance(self, p: Vec3) -> tuple[Array, Vec3]:
        """Exact. At the centre, up to rounding errors, normal and gradient are zero."""
        return _round(p, self.radius)

    def bounding_box(self) -> tuple[Array, Array]:
        """Exact."""
        return around_origin(self.radius, self.radius, self.radius)

    def bounding_radius(self) -> Scalar:
        """Exact."""
        return self.radius

    def volume(self) -> Scalar:
        """Exact."""
        return 4.0 / 3.0 * math.pi * self.radius**3

    def inertia(self, density: Scalar) -> tuple[Scalar, Array]:
        """Exact."""
        mass = density * (4.0 / 3.0) * math.pi * self.radius**3
        return mass, jnp.eye(3) * (0.4 * mass * self.radius**2)

    def cast(self, origin: Vec3, direction: Vec3) -> Array:
        """Exact."""
        return ball_entry(origin, direction, self.radius)

    def draw(self) -> list[Drawing]:
        """A sphere."""
        return [{"kind": "sphere", "center": ORIGIN, "radius": self.radius}]


@struct.dataclass
class Capsule(Shape):
    """All points within ``radius`` of the segment from (0, -half_length, 0) to (0, half_length, 0) [m]."""

    radius: Scalar = struct.number(POSITIVE, "give a length in metres", shape=())
    half_length: Scalar = struct.number(NOT_NEGATIVE, "give a length in metres", shape=())
    has_edges = False

    def distance(self, p: Vec3) -> tuple[Array, Vec3]:
        """Exact. On the axis, up to rounding errors, normal and gradient are zero."""
        nearest = clipped(p[1], -self.half_length, self.half_length)
        return _round((p[0], p[1] - nearest, p[2]), self.radius)

    def bounding_box(self) -> tuple[Array, Array]:
        """Exact."""
        return around_origin(self.radius, self.half_length + self.radius, self.radius)

    def bounding_radius(self) -> Scalar:
        """Exact."""
        return self.radius + self.half_length

    def volume(self) -> Scalar:
        """Exact."""
        return math.pi * self.radius**2 * (2.0 * self.half_length + 4.0 / 3.0 * self.radius)

    def inertia(self, density: Scalar) -> tuple[Scalar, Array]:
        """Exact."""
        r, h = self.radius, self.half_length
        tube, along, across = cylinder_inertia(r, 2.0 * h, density)
        ball = density * (4.0 / 3.0) * math.pi * r**3
        # Each cap's centre of mass lies 3/8 r beyond the tube's end.
        across = across + ball * (0.4 * r * r + h * h + 0.75 * h * r)
        along = along + 0.4 * ball * r * r
        return tube + ball, jnp.diag(jnp.stack([across, along, across]))

    def cast(self, origin: Vec3, direction: Vec3) -> Array:
        """Exact."""
        return capsule_entry(origin, direction, self.radius, self.half_length)

    def draw(self) -> list[Drawing]:
        """A capsule."""
        size = {"radius": self.radius, "half_length": self.half_length}
        return [{"kind": "capsule", "center": ORIGIN, **size, "direction": UPRIGHT}]


def _round(p: Vec3, radius: Scalar) -> tuple[Array, Vec3]:
    square = cp.dot(p, p)
    inverse = inverse_distance(square, radius)
    return square * inverse - radius, cp.scale(inverse, p)


__all__ = ["Capsule", "Sphere"]
