"""Exact signed distance of an ellipsoid: Newton steps find the nearest point; its derivative is hand-written."""

import math

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.lowering.fusion import materialize
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import POSITIVE
from rewax.physics.numerics.components import Vec3
from rewax.physics.shapes.base import Shape
from rewax.physics.shapes.drawn import ORIGIN, STRAIGHT, Drawing
from rewax.physics.shapes.rays import ball_entry
from rewax.types import Array, Scalar, Vector

NUM_ITERATIONS = 16
"""Newton steps. Half of them reach rounding error, except close to the focal disc deep inside. There the error after
all of them is up to 1e-3 for the normal and the square of that for the distance."""


@struct.dataclass
class Ellipsoid(Shape):
    """An ellipsoid around the origin. ``semi_axes``: half its extents along x, y, z [m], shape (3,), > 0."""

    semi_axes: Vector = struct.number(POSITIVE, "give three lengths in metres", shape=(3,))

    def distance(self, p: Vec3) -> tuple[Array, Vec3]:
        """Exact; see ``ellipsoid_distance``."""
        return ellipsoid_distance((self.semi_axes[..., 0], self.semi_axes[..., 1], self.semi_axes[..., 2]), p)

    def bounding_box(self) -> tuple[Array, Array]:
        """Exact."""
        half = jnp.asarray(self.semi_axes)
        return -half, half

    def bounding_radius(self) -> Scalar:
        """Exact."""
        return jnp.max(jnp.asarray(self.semi_axes), axis=-1)

    def volume(self) -> Scalar:
        """Exact."""
        return 4.0 / 3.0 * math.pi * jnp.prod(jnp.asarray(self.semi_axes))

    def inertia(self, density: Scalar) -> tuple[Scalar, Array]:
        """Exact."""
        mass, squares = density * self.volume(), jnp.asarray(self.semi_axes) ** 2
        return mass, jnp.diag(jnp.sum(squares) - squares) * (mass / 5.0)

    def cast(self, origin: Vec3, direction: Vec3) -> Array:
        """Exact: a ball of radius 1 once lengths are divided by the semi-axes."""
        start = cp.vector(lambda i: origin[i] / self.semi_axes[..., i])
        return ball_entry(start, cp.vector(lambda i: direction[i] / self.semi_axes[..., i]), 1.0)

    def draw(self) -> list[Drawing]:
        """An ellipsoid."""
        return [{"kind": "ellipsoid", "center": ORIGIN, "semi_axes": self.semi_axes, "rotation": STRAIGHT}]


def ellipsoid_distance(semi_axes: Vec3, p: Vec3) -> tuple[Array, Vec3]:
    """Signed distance to an ellipsoid around the origin, and its normal.

    Args:
      semi_axes: half the extents along x, y, z [m], broadcastable to the points, > 0.
      p: points [m], components of shape (n,).

    Gradient: exact, from the implicit function theorem. On the focal disc inside, two points of the surface are
      nearest: value and derivatives are those of one of them, also at the centre.
    Source: Eberly 2013, "Distance from a point to an ellipse, an ellipsoid, or a hyperellipsoid", section 3; solved
      by Newton steps on the reciprocal length (More & Sorensen 1983, eq. 3.10) instead of bisection.
    """
    side = cp.vector(lambda i: jnp.where(p[i] < 0, -1.0, 1.0).astype(p[i].dtype))
    squares = cp.vector(lambda i: jnp.asarray(semi_axes[i] * semi_axes[i], p[i].dtype))
    foot = materialize(_foot(cp.vector(lambda i: semi_axes[i] * side[i] * p[i]), squares))
    _, n = cp.unit(cp.vector(lambda i: side[i] * foot[i] / semi_axes[i]))
    n = materialize(n)
    # Project onto the normal: the norm of p - foot has a square root with an infinite slope at the surface.
    return cp.dot(n, cp.vector(lambda i: p[i] - side[i] * semi_axes[i] * foot[i])), n


@jax.custom_jvp
def _foot(c: Vec3, squares: Vec3) -> Vec3:
    """Nearest point divided by the semi-axes a, a unit vector: w_i = c_i / (t + a_i^2), c_i = a_i |p_i|, |w| = 1."""
    return _solve(c, squares)[0]


@_foot.defjvp
def _foot_jvp(primals: tuple[Vec3, Vec3], tangents: tuple[Vec3, Vec3]) -> tuple[Vec3, Vec3]:
    """Differentiate w_i (t + a_i^2) = c_i and |w| = 1, and solve for dw without cancellation."""
    w, depth = materialize(_solve(*primals))
    dc, dsquares = tangents
    e = cp.vector(lambda i: dc[i] - w[i] * dsquares[i])
    weight = cp.vector(lambda i: w[i] / depth[i])
    total = cp.dot(weight, w)

    def component(i: int) -> Array:
        j, k = (i + 1) % 3, (i + 2) % 3
        turn = weight[j] * (w[j] * e[i] - w[i] * e[j]) + weight[k] * (w[k] * e[i] - w[i] * e[k])
        return turn / (total * depth[i])

    return w, cp.vector(component)


def _solve(c: Vec3, squares: Vec3) -> tuple[Vec3, Vec3]:
    """w, and t + a_i^2. The unknown is s = t + min(a)^2 > 0, which keeps its digits where it is small.

    1 / |w| is concave and increasing in s, so Newton steps that start below stay below and need no safeguard.
    """
    smallest = jnp.minimum(jnp.minimum(squares[0], squares[1]), squares[2])
    above = cp.vector(lambda i: squares[i] - smallest)
    # Zero coordinates become tiny positive ones, which selects one side of the focal disc.
    c = cp.vector(lambda i: jnp.maximum(c[i], jnp.finfo(c[i].dtype).eps * smallest))
    start = jnp.maximum(jnp.maximum(c[0] - above[0], c[1] - above[1]), c[2] - above[2])

    def newton(_: int, s: Array) -> Array:
        depth = cp.vector(lambda i: s + above[i])
        w = cp.vector(lambda i: c[i] / depth[i])
        square = cp.dot(w, w)
        slope = cp.dot(w, cp.vector(lambda i: w[i] / depth[i]))
        return s + jnp.maximum(square * jnp.sqrt(square) - square, 0.0) / slope

    s = jax.lax.fori_loop(0, NUM_ITERATIONS, newton, start)
    depth = cp.vector(lambda i: s + above[i])
    return cp.unit(cp.vector(lambda i: c[i] / depth[i]))[1], depth
