"""Signed distances of shapes, with their normals.

Each shape lives in its own frame, axis along y where it has one. Distances of primitive shapes are exact Euclidean
ones, negative inside; normals are their gradients, unit length, pointing out. ``SampledDistance`` (a mesh baked to a
grid) and ``HeightField`` approximate both as their docstrings say.
"""

from typing import TypeAlias

import jax.numpy as jnp

from rewax import struct
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.shapes.ellipsoid import ellipsoid_distance
from rewax.physics.shapes.sampled import HeightField, SampledDistance, height_distance, sampled_distance
from rewax.types import Array, Scalar


@struct.dataclass
class Sphere:
    """A ball around the origin. ``radius`` [m]."""

    radius: Scalar


@struct.dataclass
class Capsule:
    """All points within ``radius`` of the segment from (0, -half_length, 0) to (0, half_length, 0) [m]."""

    radius: Scalar
    half_length: Scalar


@struct.dataclass
class Box:
    """A box around the origin. ``half_size``: half its edges along x, y, z [m], shape (3,)."""

    half_size: Array


@struct.dataclass
class Cylinder:
    """A solid cylinder around y. ``radius`` and ``half_length`` [m]."""

    radius: Scalar
    half_length: Scalar


@struct.dataclass
class Cone:
    """A solid cone around y: base of ``radius`` at y = -half_length, apex at y = +half_length [m]."""

    radius: Scalar
    half_length: Scalar


@struct.dataclass
class Ellipsoid:
    """An ellipsoid around the origin. ``semi_axes``: half its extents along x, y, z [m], shape (3,), > 0."""

    semi_axes: Array


@struct.dataclass
class Plane:
    """The half-space y < 0; its surface is y = 0 and its normal (0, 1, 0)."""


Shape: TypeAlias = Sphere | Capsule | Box | Cylinder | Cone | Ellipsoid | Plane | SampledDistance | HeightField
"""Whatever has a signed distance."""


def has_edges(shape: Shape) -> bool:
    """Whether the normal jumps from one face or cell to the next, so that all its users must see the same one."""
    return not isinstance(shape, Sphere | Capsule | Plane)


def signed_distance(shape: Shape, points: Array) -> tuple[Array, Array]:
    """Distance to a shape's surface, and the direction away from it.

    Args:
      shape: the shape, in its own frame.
      points: where to evaluate, in the shape's frame [m], shape (..., 3).

    Returns:
      Signed distance [m], shape (...), negative inside; unit normal, shape (..., 3).

    Gradient: exact with respect to points and the shape's sizes, finite everywhere. On the medial axis (the middle of
      a ball, the axis of a capsule), where the normal is not defined, it is zero or the mean of those around it (on the
      axis of a cone), except in an ellipsoid, which takes one of the nearest points; edges take one side's.
    """
    d, n = signed_distance_components(shape, cp.split_vector(points))
    return d, cp.join_vector(n)


def signed_distance_components(shape: Shape, p: Vec3) -> tuple[Array, Vec3]:
    """``signed_distance`` on components."""
    match shape:
        case Sphere():
            return _round(p, shape.radius)
        case Capsule():
            nearest = jnp.clip(p[1], -shape.half_length, shape.half_length)
            return _round((p[0], p[1] - nearest, p[2]), shape.radius)
        case Box():
            return _box(p, (shape.half_size[..., 0], shape.half_size[..., 1], shape.half_size[..., 2]))
        case Cylinder():
            return _cylinder(p, shape.radius, shape.half_length)
        case Cone():
            return _cone(p, shape.radius, shape.half_length)
        case Ellipsoid():
            return ellipsoid_distance((shape.semi_axes[..., 0], shape.semi_axes[..., 1], shape.semi_axes[..., 2]), p)
        case SampledDistance():
            return sampled_distance(shape, p)
        case HeightField():
            return height_distance(shape, p)
        case Plane():
            zero = jnp.zeros_like(p[1])
            return p[1], (zero, jnp.ones_like(p[1]), zero)
    raise ValueError(
        f"shape is {shape!r}: use Sphere, Capsule, Box, Cylinder, Cone, Ellipsoid, Plane, SampledDistance or "
        "HeightField from rewax.physics.shapes"
    )


def _round(p: Vec3, radius: Scalar) -> tuple[Array, Vec3]:
    length, n = cp.unit(p)
    return length - radius, n


def _sign(a: Array) -> Array:
    return jnp.where(a < 0, -1.0, 1.0)


def _box(p: Vec3, half: Vec3) -> tuple[Array, Vec3]:
    q = cp.vector(lambda i: jnp.abs(p[i]) - half[i])
    deepest = jnp.maximum(jnp.maximum(q[0], q[1]), q[2])
    outside, corner = cp.unit(cp.vector(lambda i: jnp.maximum(q[i], 0.0)))
    is_x = q[0] >= deepest
    is_y = ~is_x & (q[1] >= deepest)
    face = (is_x, is_y, ~is_x & ~is_y)
    inside = deepest <= 0
    n = cp.vector(lambda i: _sign(p[i]) * jnp.where(inside, jnp.where(face[i], 1.0, 0.0), corner[i]))
    return jnp.where(inside, deepest, outside), n


def _cylinder(p: Vec3, radius: Scalar, half_length: Scalar) -> tuple[Array, Vec3]:
    square = p[0] * p[0] + p[2] * p[2]
    inverse = cp.safe_rsqrt(square)
    r = square * inverse
    side, cap = r - radius, jnp.abs(p[1]) - half_length
    a, b = jnp.maximum(side, 0.0), jnp.maximum(cap, 0.0)
    scale = cp.safe_rsqrt(a * a + b * b)
    outside = (a * a + b * b) * scale
    inside = jnp.maximum(side, cap) <= 0
    on_side = side >= cap
    radial = jnp.where(inside, jnp.where(on_side, 1.0, 0.0), a * scale)
    axial = jnp.where(inside, jnp.where(on_side, 0.0, 1.0), b * scale)
    distance = jnp.where(inside, jnp.maximum(side, cap), outside)
    return distance, (radial * p[0] * inverse, axial * _sign(p[1]), radial * p[2] * inverse)


def _cone(p: Vec3, radius: Scalar, half_length: Scalar) -> tuple[Array, Vec3]:
    """In the half-plane (r, y) the cone is the triangle of the axis, the base and the slant."""
    square = p[0] * p[0] + p[2] * p[2]
    inverse = cp.safe_rsqrt(square)
    r = square * inverse
    height = 2.0 * half_length
    shrink = cp.safe_rsqrt(jnp.asarray(radius * radius + height * height))
    slant_r, slant_y = height * shrink, radius * shrink  # normal of the slant
    from_edge_r, from_edge_y = r - radius, p[1] + half_length
    slant, base = from_edge_r * slant_r + from_edge_y * slant_y, -from_edge_y
    inside = jnp.maximum(slant, base) <= 0
    # How far along the slant, from the edge of the base (0) to the apex (1).
    along = (from_edge_y * slant_r - from_edge_r * slant_y) * shrink
    to_slant = jnp.where(inside, slant >= base, (slant > 0) & (along > 0) & (along < 1))
    to_base = jnp.where(inside, slant < base, (slant <= 0) & (from_edge_r < 0))
    to_apex = (slant > 0) & (along >= 1)
    corner_r = jnp.where(to_apex, r, from_edge_r)
    corner_y = jnp.where(to_apex, p[1] - half_length, from_edge_y)
    from_corner = corner_r * corner_r + corner_y * corner_y
    scale = cp.safe_rsqrt(from_corner)
    distance = jnp.where(to_slant, slant, jnp.where(to_base, base, from_corner * scale))
    radial = jnp.where(to_slant, slant_r, jnp.where(to_base, 0.0, corner_r * scale))
    axial = jnp.where(to_slant, slant_y, jnp.where(to_base, -1.0, corner_y * scale))
    return distance, (radial * p[0] * inverse, axial, radial * p[2] * inverse)


__all__ = [
    "Box",
    "Capsule",
    "Cone",
    "Cylinder",
    "Ellipsoid",
    "HeightField",
    "Plane",
    "SampledDistance",
    "Shape",
    "Sphere",
    "signed_distance",
    "signed_distance_components",
]
