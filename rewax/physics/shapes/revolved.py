"""Solids of revolution with edges: cylinders and cones around y."""

import math

import jax.numpy as jnp

from rewax import struct
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import POSITIVE
from rewax.physics.numerics.components import Vec3
from rewax.physics.shapes.base import Shape, around_origin, inverse_distance, mean_of_nearest, rounding_error
from rewax.physics.shapes.drawn import ORIGIN, UPRIGHT, Drawing
from rewax.physics.shapes.rays import common_entry, cone_entry, slab_interval, tube_interval
from rewax.types import Array, Scalar


class _Revolved(Shape):
    """Base of cylinders and cones."""

    radius: Scalar
    half_length: Scalar

    def bounding_box(self) -> tuple[Array, Array]:
        """Exact."""
        return around_origin(self.radius, self.half_length, self.radius)

    def bounding_radius(self) -> Scalar:
        """Exact."""
        return jnp.sqrt(jnp.asarray(self.radius) ** 2 + jnp.asarray(self.half_length) ** 2)

    def draw(self) -> list[Drawing]:
        """A cylinder or a cone."""
        size = {"radius": self.radius, "half_length": self.half_length}
        return [{"kind": type(self).__name__.lower(), "center": ORIGIN, **size, "direction": UPRIGHT}]


@struct.dataclass
class Cylinder(_Revolved):
    """A solid cylinder around y. ``radius`` and ``half_length`` [m]."""

    radius: Scalar = struct.number(POSITIVE, "give a length in metres", shape=())
    half_length: Scalar = struct.number(POSITIVE, "give a length in metres", shape=())

    def distance(self, p: Vec3) -> tuple[Array, Vec3]:
        """Exact. On the axis the normal's radial part is zero; on the edges it is the mean, as for ``Box``."""
        square = p[0] * p[0] + p[2] * p[2]
        inverse = inverse_distance(square, self.radius)
        r = square * inverse
        side, cap = r - self.radius, jnp.abs(p[1]) - self.half_length
        a, b = jnp.maximum(side, 0.0), jnp.maximum(cap, 0.0)
        scale = cp.safe_rsqrt(a * a + b * b)
        outside = (a * a + b * b) * scale
        deepest = jnp.maximum(side, cap)
        unsure = rounding_error(jnp.maximum(self.radius, self.half_length), p[0])
        on_side, on_cap = mean_of_nearest((side, cap), deepest - unsure)
        inside = deepest <= unsure
        radial = jnp.where(inside, on_side, a * scale)
        axial = jnp.where(inside, on_cap, b * scale)
        distance = jnp.where(inside, deepest, outside)
        return distance, (radial * p[0] * inverse, axial * jnp.where(p[1] < 0, -1.0, 1.0), radial * p[2] * inverse)

    def cast(self, origin: Vec3, direction: Vec3) -> Array:
        """Exact."""
        return common_entry(
            tube_interval(origin, direction, self.radius), slab_interval(origin[1], direction[1], self.half_length)
        )

    def volume(self) -> Scalar:
        """Exact."""
        return 2.0 * math.pi * self.radius**2 * self.half_length

    def inertia(self, density: Scalar) -> tuple[Scalar, Array]:
        """Exact."""
        mass, along, across = cylinder_inertia(self.radius, 2.0 * self.half_length, density)
        return mass, jnp.diag(jnp.stack([across, along, across]))


@struct.dataclass
class Cone(_Revolved):
    """A solid cone around y: base of ``radius`` at y = -half_length, apex at y = +half_length [m]."""

    radius: Scalar = struct.number(POSITIVE, "give a length in metres", shape=())
    half_length: Scalar = struct.number(POSITIVE, "give a length in metres", shape=())

    def distance(self, p: Vec3) -> tuple[Array, Vec3]:
        """Exact: in the half-plane (r, y) the cone is the triangle of the axis, the base and the slant."""
        radius, half_length = self.radius, self.half_length
        square = p[0] * p[0] + p[2] * p[2]
        inverse = inverse_distance(square, radius)
        r = square * inverse
        height = 2.0 * half_length
        shrink = cp.safe_rsqrt(jnp.asarray(radius * radius + height * height))
        slant_r, slant_y = height * shrink, radius * shrink  # normal of the slant
        from_edge_r, from_edge_y = r - radius, p[1] + half_length
        slant, base = from_edge_r * slant_r + from_edge_y * slant_y, -from_edge_y
        unsure = rounding_error(jnp.maximum(radius, half_length), p[0])
        inside = jnp.maximum(slant, base) <= unsure  # rounding does not decide the normal on the edge
        # Coordinate along the slant, from the edge of the base (0) to the apex (1).
        along = (from_edge_y * slant_r - from_edge_r * slant_y) * shrink
        to_slant = jnp.where(inside, slant >= base - unsure, (slant > 0) & (along > 0) & (along < 1))
        to_base = jnp.where(inside, slant < base - unsure, (slant <= 0) & (from_edge_r < 0))
        to_apex = (slant > 0) & (along >= 1)
        corner_r = jnp.where(to_apex, r, from_edge_r)
        corner_y = jnp.where(to_apex, p[1] - half_length, from_edge_y)
        from_corner = corner_r * corner_r + corner_y * corner_y
        scale = cp.safe_rsqrt(from_corner)
        distance = jnp.where(to_slant, slant, jnp.where(to_base, base, from_corner * scale))
        radial = jnp.where(to_slant, slant_r, jnp.where(to_base, 0.0, corner_r * scale))
        axial = jnp.where(to_slant, slant_y, jnp.where(to_base, -1.0, corner_y * scale))
        return distance, (radial * p[0] * inverse, axial, radial * p[2] * inverse)

    def cast(self, origin: Vec3, direction: Vec3) -> Array:
        """Exact."""
        return cone_entry(origin, direction, self.radius, self.half_length)

    def volume(self) -> Scalar:
        """Exact."""
        return 2.0 / 3.0 * math.pi * self.radius**2 * self.half_length


def cylinder_inertia(radius: Scalar, length: Scalar, density: Scalar) -> tuple[Array, Array, Array]:
    """Mass [kg] of a cylinder, and moments of inertia about its axis and across it [kg m^2], shape () each."""
    mass = jnp.asarray(density * math.pi * radius**2 * length)
    return mass, 0.5 * mass * radius**2, mass * (3.0 * radius**2 + length**2) / 12.0


__all__ = ["Cone", "Cylinder", "cylinder_inertia"]
