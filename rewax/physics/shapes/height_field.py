"""Terrain given by heights at the nodes of a grid."""

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.lowering.fusion import materialize
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import FINITE, POSITIVE
from rewax.physics.numerics.components import Vec3
from rewax.physics.shapes.base import Shape
from rewax.physics.shapes.drawn import Drawing, mesh
from rewax.physics.shapes.grid_cells import check_nodes, locate, take
from rewax.physics.shapes.rays import bilinear_entry
from rewax.physics.shapes.sampled_surface import height_surface
from rewax.types import Array, Scalar, Vector


@struct.dataclass
class HeightField(Shape):
    """Solid ground under a height that is bilinear between the nodes of a regular grid in x and z.

    The distance is the vertical one times the normal's y component: exact for a plane, to first order elsewhere. Beyond
    the grid the heights of its border continue.

    Attributes:
      heights: y of the surface at the nodes [m], shape (nx, nz), at least 2 along each axis.
      origin: x and z of node (0, 0) [m], shape (2,).
      spacing: distance of neighbouring nodes [m].
    """

    heights: Vector = struct.number(FINITE, "give heights in metres", shape=("nx", "nz"))
    origin: Vector = struct.number(FINITE, "give x and z in metres", shape=(2,))
    spacing: Scalar = struct.number(POSITIVE, "give a length in metres", shape=())
    is_exact = False

    def distance(self, p: Vec3) -> tuple[Array, Vec3]:
        """Height above the surface times the normal's y component, and the surface's normal at the same x and z.

        Raises:
          ValueError: fewer than two nodes along an axis.

        Gradient: exact for the returned values, with respect to points, heights, origin and spacing; at the edges of
          cells that of one side.
        """
        heights = jnp.asarray(self.heights)
        check_nodes("HeightField.heights", heights.shape, "xz")
        ix, fx, beyond_x = locate(p[0], self.origin[..., 0], self.spacing, heights.shape[0])
        iz, fz, beyond_z = locate(p[2], self.origin[..., 1], self.spacing, heights.shape[1])
        nz = heights.shape[1]
        lowest, flat = ix * nz + iz, heights.reshape(-1)
        corners = materialize(tuple(take(flat, lowest + a * nz + c) for a in (0, 1) for c in (0, 1)))
        ends = [corners[2 * k] + fz * (corners[2 * k + 1] - corners[2 * k]) for k in range(2)]
        slopes = [corners[2 * k + 1] - corners[2 * k] for k in range(2)]
        slope_x = jnp.where(beyond_x == 0, (ends[1] - ends[0]) / self.spacing, 0.0)
        slope_z = jnp.where(beyond_z == 0, (slopes[0] + fx * (slopes[1] - slopes[0])) / self.spacing, 0.0)
        _, n = cp.unit((-slope_x, jnp.ones_like(slope_x), -slope_z))
        return (p[1] - (ends[0] + fx * (ends[1] - ends[0]))) * n[1], n

    def cast(self, origin: Vec3, direction: Vec3) -> Array:
        """Exact. Gradient: exact for the cell that a ray meets, by ray, heights, origin and spacing."""
        t = bilinear_entry(
            jnp.asarray(self.heights), (self.origin[..., 0], self.origin[..., 1]), self.spacing, origin, direction
        )
        meets = jnp.isfinite(t)
        met = jnp.where(meets, t, 0.0)
        distance, normal = self.distance(cp.vector(lambda i: origin[i] + met * direction[i]))
        approach = jax.lax.stop_gradient(-cp.dot(normal, direction))
        steep = approach > 1e-12
        # A Newton step that leaves the value as it is and has the derivative of the implicit function.
        change = (distance - jax.lax.stop_gradient(distance)) / jnp.where(steep, approach, 1.0)
        return jnp.where(meets, met + jnp.where(steep, change, 0.0), jnp.inf)

    def draw(self) -> list[Drawing]:
        """A mesh of the surface over its grid, cached by heights."""
        return mesh(height_surface(self.heights, self.origin, self.spacing))


__all__ = ["HeightField"]
