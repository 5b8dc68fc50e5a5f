"""Shapes with flat faces: boxes and half-spaces."""

import jax.numpy as jnp

from rewax import struct
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import POSITIVE
from rewax.physics.numerics.components import Vec3
from rewax.physics.shapes.base import Shape, mean_of_nearest, rounding_error
from rewax.physics.shapes.drawn import ORIGIN, STRAIGHT, Drawing
from rewax.physics.shapes.rays import common_entry, plane_entry, slab_interval
from rewax.types import Array, Scalar, Vector


@struct.dataclass
class Box(Shape):
    """A box around the origin. ``half_size``: half its edges along x, y, z [m], shape (3,)."""

    half_size: Vector = struct.number(POSITIVE, "give three lengths in metres", shape=(3,))
    fills_its_box = True

    def distance(self, p: Vec3) -> tuple[Array, Vec3]:
        """Exact. Inside, the normal is that of the nearest face, and the mean of several that are equally near.

        A point that is outside by no more than rounding errors counts as inside. Otherwise rounding would decide the
        normal on an edge, and its derivative there would be the inverse of a rounding error.
        """
        half = (self.half_size[..., 0], self.half_size[..., 1], self.half_size[..., 2])
        q = cp.vector(lambda i: jnp.abs(p[i]) - half[i])
        deepest = jnp.maximum(jnp.maximum(q[0], q[1]), q[2])
        outside, corner = cp.unit(cp.vector(lambda i: jnp.maximum(q[i], 0.0)))
        unsure = rounding_error(jnp.maximum(jnp.maximum(half[0], half[1]), half[2]), p[0])
        share = mean_of_nearest(q, deepest - unsure)
        inside = deepest <= unsure

        def normal(i: int) -> Array:
            return jnp.where(p[i] < 0, -1.0, 1.0) * jnp.where(inside, share[i], corner[i])

        return jnp.where(inside, deepest, outside), cp.vector(normal)

    def bounding_box(self) -> tuple[Array, Array]:
        """Exact."""
        half = jnp.asarray(self.half_size)
        return -half, half

    def bounding_radius(self) -> Scalar:
        """Exact."""
        return jnp.sqrt(jnp.sum(jnp.asarray(self.half_size) ** 2, axis=-1))

    def volume(self) -> Scalar:
        """Exact."""
        return 8.0 * jnp.prod(jnp.asarray(self.half_size))

    def inertia(self, density: Scalar) -> tuple[Scalar, Array]:
        """Exact."""
        a, b, c = (2.0 * self.half_size[..., i] for i in range(3))
        mass = density * a * b * c
        return mass, jnp.diag(jnp.stack([b * b + c * c, a * a + c * c, a * a + b * b])) * (mass / 12.0)

    def cast(self, origin: Vec3, direction: Vec3) -> Array:
        """Exact."""
        return common_entry(*(slab_interval(origin[i], direction[i], self.half_size[..., i]) for i in cp.AXES))

    def draw(self) -> list[Drawing]:
        """A box."""
        return [{"kind": "box", "center": ORIGIN, "half_size": self.half_size, "rotation": STRAIGHT}]


@struct.dataclass
class Plane(Shape):
    """The half-space y < 0; its surface is y = 0 and its normal (0, 1, 0). It has no bounds and is not drawn."""

    has_edges = False

    def distance(self, p: Vec3) -> tuple[Array, Vec3]:
        """Exact."""
        zero = jnp.zeros_like(p[1])
        return p[1], (zero, jnp.ones_like(p[1]), zero)

    def cast(self, origin: Vec3, direction: Vec3) -> Array:
        """Exact."""
        return plane_entry(origin, direction)


__all__ = ["Box", "Plane"]
