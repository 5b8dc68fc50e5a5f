"""Solids of any form, given by distances at the nodes of a grid."""

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax import struct
from rewax.lowering.fusion import materialize
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import FINITE, POSITIVE
from rewax.physics.numerics.components import Vec3
from rewax.physics.shapes.base import Shape
from rewax.physics.shapes.drawn import Drawing, mesh
from rewax.physics.shapes.grid_cells import check_nodes, locate, take
from rewax.physics.shapes.quadrature import fractions_below_zero
from rewax.physics.shapes.rays import common_entry, slab_interval, traced_entry
from rewax.physics.shapes.sampled_surface import sampled_surface
from rewax.types import Array, Scalar, Vector


@struct.dataclass
class SampledDistance(Shape):
    """A solid given by its signed distance at the nodes of a regular grid; ``mesh_sdf.bake_mesh`` makes one of a mesh.

    Between nodes the distance is the trilinear interpolant; the normal is the interpolant's exact gradient, normalised.
    Where the surface is smooth, the distance has an error of order spacing^2 and the normal of order spacing. Beyond
    the grid the distance is the distance to the grid's box plus the value at the nearest point of the box. This is
    never less than the true distance, so the grid should contain the margin in which contact acts.

    Attributes:
      values: signed distance at the nodes [m], negative inside, shape (nx, ny, nz), at least 2 along each axis.
      origin: position of node (0, 0, 0) in the shape's frame [m], shape (3,).
      spacing: distance of neighbouring nodes [m].
    """

    values: Vector = struct.number(FINITE, "give distances in metres", shape=("nx", "ny", "nz"))
    origin: Vector = struct.number(FINITE, "give a position in metres", shape=(3,))
    spacing: Scalar = struct.number(POSITIVE, "give a length in metres", shape=())
    is_exact = False

    def distance(self, p: Vec3) -> tuple[Array, Vec3]:
        """The interpolant and its normalised gradient; where the interpolant is flat the normal is zero.

        Raises:
          ValueError: fewer than two nodes along an axis.

        Gradient: exact for the interpolant, with respect to points, values, origin and spacing; at the faces of cells
          that of one side.
        """
        values = jnp.asarray(self.values)
        check_nodes("SampledDistance.values", values.shape, "xyz")
        cells = [locate(p[i], self.origin[..., i], self.spacing, values.shape[i]) for i in cp.AXES]
        beyond = cp.vector(lambda i: self.spacing * cells[i][2])
        (ix, fx, _), (iy, fy, _), (iz, fz, _) = cells
        _, ny, nz = values.shape
        lowest, flat = (ix * ny + iy) * nz + iz, values.reshape(-1)
        # Stored, because value and gradient both read the corners.
        corners = materialize(
            tuple(take(flat, lowest + (a * ny + b) * nz + c) for a in (0, 1) for b in (0, 1) for c in (0, 1))
        )
        along_z = [corners[2 * k] + fz * (corners[2 * k + 1] - corners[2 * k]) for k in range(4)]
        along_yz = [along_z[2 * k] + fy * (along_z[2 * k + 1] - along_z[2 * k]) for k in range(2)]
        value = along_yz[0] + fx * (along_yz[1] - along_yz[0])
        slopes_z = [corners[2 * k + 1] - corners[2 * k] for k in range(4)]
        slopes_yz = [slopes_z[2 * k] + fy * (slopes_z[2 * k + 1] - slopes_z[2 * k]) for k in range(2)]
        slopes_y = [along_z[2 * k + 1] - along_z[2 * k] for k in range(2)]
        slope = (
            along_yz[1] - along_yz[0],
            slopes_y[0] + fx * (slopes_y[1] - slopes_y[0]),
            slopes_yz[0] + fx * (slopes_yz[1] - slopes_yz[0]),
        )
        outside, away = cp.unit(beyond)
        gradient = cp.vector(lambda i: jnp.where(beyond[i] == 0, slope[i] / self.spacing, away[i]))
        return value + outside, cp.unit(gradient)[1]

    def bounding_box(self) -> tuple[Array, Array]:
        """Bounds of the cells with a negative corner, plus one cell on each side within the grid. Gradient: none.

        Raises:
          ValueError: the values are traced, or nowhere negative.
        """
        if any(isinstance(number, Tracer) for number in (self.values, self.origin, self.spacing)):
            raise ValueError("SampledDistance is traced, so its bounds are unknown: call bounding_box before jit")
        inside = np.argwhere(np.asarray(self.values) < 0)
        if len(inside) == 0:
            raise ValueError(
                "SampledDistance.values is nowhere negative, so the shape is empty: bake it with less spacing"
            )
        # The surface is at most one cell beyond the nodes inside.
        nodes = np.clip([inside.min(axis=0) - 1, inside.max(axis=0) + 1], 0, np.array(self.values.shape) - 1)
        lower, upper = np.asarray(self.origin, np.float64) + float(self.spacing) * nodes
        return lower, upper

    def bounding_radius(self) -> Scalar:
        """Infinite: compiled programs call it, where values are traced."""
        return jnp.inf

    def volume(self) -> Scalar:
        """Volume of negative distance [m^3], interpolated linearly in six tetrahedra per cell.

        The error is of order spacing^2.
        """
        return jnp.sum(fractions_below_zero(jnp.asarray(self.values))) / 6.0 * self.spacing**3

    def cast(self, origin: Vec3, direction: Vec3) -> Array:
        """By sphere tracing, from where the ray enters the grid's box if it begins beyond it.

        Beyond the box the distance may be too large.
        """
        values = jnp.asarray(self.values)
        half = [0.5 * self.spacing * (values.shape[i] - 1) for i in cp.AXES]
        from_center = cp.vector(lambda i: origin[i] - (self.origin[..., i] + half[i]))
        slabs = [slab_interval(from_center[i], direction[i], half[i]) for i in cp.AXES]
        within = cp.vector(lambda i: jnp.abs(from_center[i]) <= half[i])
        begins_within = within[0] & within[1] & within[2]
        return traced_entry(self, origin, direction, jnp.where(begins_within, 0.0, common_entry(*slabs)))

    def draw(self) -> list[Drawing]:
        """A mesh, cached by values."""
        return mesh(sampled_surface(self.values, self.origin, self.spacing))


__all__ = ["SampledDistance"]
