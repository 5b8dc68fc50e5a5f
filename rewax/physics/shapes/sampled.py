"""Distances given by numbers on a grid: solids of any form, and terrain."""

from collections.abc import Sequence

import jax.numpy as jnp

from rewax import struct
from rewax.lowering.fusion import materialize
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.types import Array, Scalar


@struct.dataclass
class SampledDistance:
    """A solid given by its signed distance at the nodes of a regular grid; ``mesh_sdf.bake_mesh`` makes one of a mesh.

    Between nodes the distance is the trilinear interpolant; the normal is the interpolant's exact gradient, made unit
    length. Both are off by the order of spacing^2 (distance) and spacing (normal) where the surface is smooth. Beyond
    the grid's box the distance is the one to the box plus the value where its border is met: never less than the true
    one, so give the grid the margin in which contact acts.

    Attributes:
      values: signed distance at the nodes [m], negative inside, shape (nx, ny, nz), at least 2 along each axis.
      origin: position of node (0, 0, 0) in the shape's frame [m], shape (3,).
      spacing: distance of neighbouring nodes [m].
    """

    values: Array
    origin: Array
    spacing: Scalar


@struct.dataclass
class HeightField:
    """Solid ground under a height that is bilinear between the nodes of a regular grid in x and z.

    The distance is the vertical one times the normal's y component: exact for a plane, first order in the distance
    elsewhere, and of either sign. Beyond the grid the heights of its border continue.

    Attributes:
      heights: y of the surface at the nodes [m], shape (nx, nz), at least 2 along each axis.
      origin: x and z of node (0, 0) [m], shape (2,).
      spacing: distance of neighbouring nodes [m].
    """

    heights: Array
    origin: Array
    spacing: Scalar


def sampled_distance(shape: SampledDistance, p: Vec3) -> tuple[Array, Vec3]:
    """Signed distance [m] and normal at points, components of shape (n,).

    Gradient: exact for the interpolant, with respect to points, values, origin and spacing; one side's at the faces of
      cells. Where the interpolant is flat the normal is zero.
    """
    values = jnp.asarray(shape.values)
    _check_nodes("SampledDistance.values", values.shape, "xyz")
    place = [_locate(p[i], shape.origin[..., i], shape.spacing, values.shape[i]) for i in cp.AXES]
    beyond = cp.vector(lambda i: shape.spacing * place[i][2])
    (ix, fx, _), (iy, fy, _), (iz, fz, _) = place
    _, ny, nz = values.shape
    lowest, flat = (ix * ny + iy) * nz + iz, values.reshape(-1)
    # Stored: value and gradient take each corner again.
    corners = materialize(
        tuple(_take(flat, lowest + (a * ny + b) * nz + c) for a in (0, 1) for b in (0, 1) for c in (0, 1))
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
    gradient = cp.vector(lambda i: jnp.where(beyond[i] == 0, slope[i] / shape.spacing, away[i]))
    return value + outside, cp.unit(gradient)[1]


def height_distance(shape: HeightField, p: Vec3) -> tuple[Array, Vec3]:
    """Signed distance [m] and unit normal at points, components of shape (n,).

    Gradient: exact for what is returned, with respect to points, heights, origin and spacing; one side's at the edges
      of cells.
    """
    heights = jnp.asarray(shape.heights)
    _check_nodes("HeightField.heights", heights.shape, "xz")
    ix, fx, beyond_x = _locate(p[0], shape.origin[..., 0], shape.spacing, heights.shape[0])
    iz, fz, beyond_z = _locate(p[2], shape.origin[..., 1], shape.spacing, heights.shape[1])
    nz = heights.shape[1]
    lowest, flat = ix * nz + iz, heights.reshape(-1)
    corners = materialize(tuple(_take(flat, lowest + a * nz + c) for a in (0, 1) for c in (0, 1)))
    ends = [corners[2 * k] + fz * (corners[2 * k + 1] - corners[2 * k]) for k in range(2)]
    slopes = [corners[2 * k + 1] - corners[2 * k] for k in range(2)]
    slope_x = jnp.where(beyond_x == 0, (ends[1] - ends[0]) / shape.spacing, 0.0)
    slope_z = jnp.where(beyond_z == 0, (slopes[0] + fx * (slopes[1] - slopes[0])) / shape.spacing, 0.0)
    _, n = cp.unit((-slope_x, jnp.ones_like(slope_x), -slope_z))
    return (p[1] - (ends[0] + fx * (ends[1] - ends[0]))) * n[1], n


def _locate(x: Array, origin: Scalar, spacing: Scalar, num_nodes: int) -> tuple[Array, Array, Array]:
    """Cell along an axis, the place in it from 0 to 1, and how many cells beyond the grid's end."""
    cells = (x - origin) / spacing
    end = num_nodes - 1.0
    within = jnp.clip(cells, 0.0, end)
    # Clipped again as an integer: NaN must not become an index out of bounds.
    cell = jnp.clip(jnp.floor(within).astype(jnp.int32), 0, num_nodes - 2)
    return cell, within - cell.astype(x.dtype), cells - within


def _take(flat: Array, index: Array) -> Array:
    return flat.at[index].get(mode="promise_in_bounds")


def _check_nodes(name: str, shape: Sequence[int], axes: str) -> None:
    if len(shape) != len(axes) or min(shape) < 2:
        raise ValueError(f"{name} has shape {tuple(shape)}: give at least two nodes along each of {', '.join(axes)}")
