"""The base of all shapes: the methods of a solid, with defaults derived from its distance."""

from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.arguments import check_pytree
from rewax.physics.numerics.checks import as_array, shown
from rewax.physics.numerics.components import Vec3
from rewax.physics.shapes import quadrature
from rewax.physics.shapes.distance_surface import distance_surface
from rewax.physics.shapes.drawn import Drawing, mesh
from rewax.physics.shapes.rays import traced_entry
from rewax.physics.shapes.solid import corners_of, distance_to
from rewax.types import Array, Scalar


class Shape(struct.Replaceable):
    """A rigid solid in its own frame, given by its signed distance. Derive from it to add a shape.

    Decorate the class with ``rewax.struct.dataclass`` and declare sizes with ``struct.number``, which states their
    legal values. Write ``distance``, and ``bounding_box`` if the solid is bounded. Everything else has a default.
    ``rewax.testing.check_shape`` checks the result; docs/your_own_shape.md builds a torus.

    Example:
      >>> @struct.dataclass
      ... class Ball(Shape):
      ...     radius: Scalar = struct.number(POSITIVE, "give a length in metres")
      ...
      ...     def distance(self, p):
      ...         length, normal = cp.unit(p)
      ...         return length - self.radius, normal
    """

    has_edges: ClassVar[bool] = True
    """Whether the normal jumps at edges. Contact then computes points in the shape's frame once, so that distance and
    normal belong to one face. True is always correct; False suits smooth surfaces and is faster on a GPU."""
    is_exact: ClassVar[bool] = True
    """Whether ``distance`` is the Euclidean distance everywhere. False: only to first order near the surface."""
    fills_its_box: ClassVar[bool] = False
    """Whether the shape equals its bounding box. ``fill`` then cuts the box's edges into equal intervals."""

    def distance(self, p: Vec3) -> tuple[Array, Vec3]:
        """Signed distance to the surface, and its gradient.

        Args:
          p: points in the shape's frame [m], components of one shape (...).

        Returns:
          Signed distance [m], shape (...), negative inside; unit normal, its gradient, components of shape (...).

        Raises:
          ValueError: the class does not write this method.

        Gradient: must be exact with respect to p and sizes, and finite everywhere. ``components.unit``, ``safe_sqrt``
          and ``safe_rsqrt`` are finite where the distance has a kink (at the centre of a ball).
        """
        raise ValueError(f"{type(self).__name__} has no distance: write its method distance(self, p)")

    def bounding_box(self) -> tuple[Array, Array]:
        """Smallest and largest coordinates [m], shape (3,) each; by default those of the ball of ``bounding_radius``.

        Raises:
          ValueError: the class writes neither this method nor ``bounding_radius``, so it counts as unbounded.

        Gradient: exact with respect to sizes.
        """
        if not _writes(self, "bounding_radius"):
            name = type(self).__name__
            raise ValueError(
                f"shape is a {name}, which has no bounds: use one that has, such as Box, or write the method "
                f"bounding_box(self) of {name}"
            )
        return around_origin(*[self.bounding_radius()] * 3)

    def bounding_radius(self) -> Scalar:
        """Radius of a ball around the origin that holds the shape [m]; by default through ``bounding_box``'s corners.

        Infinite for shapes without bounds. Gradient: exact with respect to sizes.
        """
        if not _writes(self, "bounding_box"):
            return jnp.inf
        lower, upper = corners_of(self)
        farthest = jnp.maximum(jnp.abs(jnp.asarray(lower)), jnp.abs(jnp.asarray(upper)))
        return jnp.sqrt(jnp.sum(farthest**2, axis=-1))

    @property
    def is_bounded(self) -> bool:
        """Whether ``bounding_box`` or ``bounding_radius`` is written."""
        return _writes(self, "bounding_box") or _writes(self, "bounding_radius")

    def volume(self) -> Scalar:
        """Volume [m^3]; by default by quadrature on 64^3 cells of the bounding box.

        The default's error is of order (cell / size)^2: below 0.2 % for the bounded shapes of rewax. It is estimated
        from half as many cells along each axis.

        Raises:
          ValueError: the shape has no bounds, or is concrete and so thin that the estimated error exceeds 1 %: write
            ``volume`` and ``inertia``.

        Gradient: exact with respect to sizes; the default differentiates the quadrature.
        """
        return quadrature.volume(*quadrature.fractions_inside(self))

    def inertia(self, density: Scalar) -> tuple[Scalar, Array]:
        """Mass and moments of inertia of a homogeneous solid whose centre of mass is the origin.

        The default is a quadrature like that of ``volume``.

        Args:
          density: [kg/m^3], > 0.

        Returns:
          Mass [kg], shape (); moments and products of inertia about the origin [kg m^2], shape (3, 3).

        Raises:
          ValueError: as for ``volume``, or the centre of mass is concrete and not the origin.

        Gradient: as for ``volume``.
        """
        return quadrature.inertia(type(self).__name__, density, *quadrature.fractions_inside(self))

    def cast(self, origin: Vec3, direction: Vec3) -> Array:
        """Where rays first enter the solid, by default by sphere tracing its distance (``rays.traced_entry``).

        Args:
          origin: where the rays begin, outside, in the shape's frame [m], components of shape (...).
          direction: where they go, of any length, components of shape (...).

        Returns:
          Distance in units of the direction's length, shape (...), infinite where a ray misses or begins inside.

        Gradient: exact by rays and sizes for the surface that a ray meets; a camera with ``gradient=True`` passes it.
        """
        return traced_entry(self, origin, direction)

    def draw(self) -> list[Drawing]:
        """Drawings in the shape's frame, with the keys that ``rewax.viz.shapes`` lists.

        The default is a mesh of the distance (marching cubes), cached by sizes. The list is empty for shapes without
        bounds, for traced sizes, and without scikit-image. Gradient: none.
        """
        return mesh(distance_surface(self) if self.is_bounded else None)


def signed_distance(shape: Shape, points: Array) -> tuple[Array, Array]:
    """Signed distance to a shape's surface, and its gradient.

    Args:
      shape: the shape, in its own frame.
      points: points in the shape's frame [m], shape (..., 3).

    Returns:
      Signed distance [m], shape (...), negative inside; unit normal, shape (..., 3).

    Raises:
      ValueError: shape is no ``Shape``, its ``distance`` returns something else, or points are no numbers of shape
        (..., 3).

    Gradient: exact with respect to points and the shape's sizes, finite everywhere. On the medial axis (the centre of a
      ball, the axis of a capsule) the normal is not defined: there it is zero, or the mean of the normals around (on
      the axis of a cone), or that of one nearest point (in an ellipsoid). Edges take the normal of one side.
    """
    given = points if isinstance(points, jax.Array) else as_array(points)
    if given.shape[-1:] != (3,) or not jnp.issubdtype(given.dtype, jnp.number):
        raise ValueError(f"points is {shown(points)}: give points of shape (..., 3) in metres")
    d, n = distance_to(require_shape(shape), cp.split_vector(given))  # pyright: ignore[reportArgumentType]
    return d, cp.join_vector(n)


def require_shape(shape: Any, name: str = "shape") -> Shape:
    """Returns the shape after checking its type.

    Args:
      shape: a user's value.
      name: its name in messages.

    Raises:
      ValueError: its class does not derive from ``Shape`` or is no ``struct.dataclass``.
    """
    if not isinstance(shape, Shape):
        raise ValueError(
            f"{name} is {shown(shape)}: give a shape of rewax.physics.shapes, or of a class derived from Shape"
        )
    check_pytree(name, shape)
    return shape


def around_origin(x: Scalar, y: Scalar, z: Scalar) -> tuple[Array, Array]:
    """Corners of a box around the origin with the given half edges [m], shape (3,) each. Gradient: exact."""
    half = jnp.stack([jnp.asarray(x), jnp.asarray(y), jnp.asarray(z)])
    return -half, half


def rounding_error(length: Scalar, like: Array) -> Array:
    """A bound on the rounding errors of positions near a solid: 256 units in the last place of its length [m].

    So many, because positions are differences of coordinates that may be much larger than the solid.

    Args:
      length: the solid's largest size [m].
      like: gives the precision.

    Gradient: none.
    """
    return jax.lax.stop_gradient(256.0 * jnp.finfo(like.dtype).eps * jnp.asarray(length))


def inverse_distance(square: Array, length: Scalar) -> Array:
    """1 / distance to a solid's centre or axis; zero, with derivative zero, within rounding errors of it.

    Args:
      square: the distance's square [m^2].
      length: the solid's size, as for ``rounding_error`` [m].

    Gradient: exact.
    """
    return jnp.where(square > rounding_error(length, square) ** 2, cp.safe_rsqrt(square), 0.0)


def mean_of_nearest(distances: Sequence[Array], least: Array) -> list[Array]:
    """Components of a normal inside a solid, along the normals of its faces, which are at right angles.

    Args:
      distances: signed distance to each face [m].
      least: faces at this distance or nearer to the surface share the normal.

    Gradient: none.
    """
    near = [(d >= least).astype(d.dtype) for d in distances]
    scale = jax.lax.rsqrt(sum(near[1:], near[0]))
    return [n * scale for n in near]


def _writes(shape: Shape, method: str) -> bool:
    return getattr(type(shape), method) is not getattr(Shape, method)


__all__ = [
    "Shape", "around_origin", "inverse_distance", "mean_of_nearest", "require_shape", "rounding_error",
    "signed_distance",
]  # fmt: skip
