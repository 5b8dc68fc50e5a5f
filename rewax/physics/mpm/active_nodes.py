"""The nodes that take part in a step: those that particles can reach, column by column."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.splines import quadratic_bspline
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.types import Array

REACHES = (0.5, 1.0)
"""What ``reach`` can be: cells that a particle may move along an axis while a list of nodes serves."""


class ActiveNodes(NamedTuple):
    """A list of nodes, ordered by column along z; in each column it holds all from the lowest to the highest needed."""

    offset: Array
    """Add it to the index along z to have a node's place in the list, for each column, shape (num_columns,), int32."""
    index: tuple[Array, Array, Array]
    """Index of each node along x, y, z, arrays (num_active,), int32; meaningless where a place is not used."""
    position: Vec3
    """Position of each node [m], components of shape (num_active,)."""


def all_nodes(grid: Grid, dtype) -> ActiveNodes:
    """Every node of the grid, in order."""
    stride_x, stride_y, _ = grid.strides
    flat = jnp.arange(grid.num_nodes, dtype=jnp.int32)
    index = (flat // stride_x, (flat // stride_y) % grid.shape[1], flat % stride_y)
    offset = jnp.arange(grid.num_columns, dtype=jnp.int32) * stride_y
    return materialize(ActiveNodes(offset, index, _position(grid, index, dtype)))


def list_nodes(grid: Grid, x: Array, num_active: int, *, reach: float = 1.0) -> ActiveNodes:
    """The nodes that particles can touch while each moves by at most ``reach`` cells along every axis.

    Args:
      grid: all nodes.
      x: particle positions [m], shape (num_particles, 3). Gradient: none.
      num_active: how many the list holds, at least 3; further ones are left out (see ``count_nodes``).
      reach: in cells, one of ``REACHES``.
    """
    lowest, count = _columns(grid, x, reach)
    end = jnp.cumsum(count, dtype=jnp.int32)
    offset = end - count - lowest
    place = jnp.arange(num_active, dtype=jnp.int32)
    column = jnp.searchsorted(end, place, side="right").astype(jnp.int32)
    column = jnp.minimum(column, grid.num_columns - 1)
    z = jnp.clip(place - offset[column], 0, grid.shape[2] - 1)
    index = (column // grid.shape[1], column % grid.shape[1], z)
    return materialize(ActiveNodes(offset, index, _position(grid, index, x.dtype)))


def count_nodes(grid: Grid, x: Array, *, reach: float = 1.0) -> Array:
    """How many nodes ``list_nodes`` has to hold, shape (), int32."""
    return jnp.sum(_columns(grid, x, reach)[1], dtype=jnp.int32)


def _columns(grid: Grid, x: Array, reach: float) -> tuple[Array, Array]:
    """Lowest node in reach of a particle, and how many nodes from it to the highest, for each column along z."""
    down = int(reach)
    half = reach - down  # half a cell to either side is one node more: below, if the particle is put half a cell lower
    up = down + int(2.0 * half)
    x = jax.lax.stop_gradient(x) - half * grid.spacing if half else jax.lax.stop_gradient(x)
    bx, by, bz = (
        quadratic_bspline(x[:, a], origin=grid.origin[a], spacing=grid.spacing, num_nodes=grid.shape[a]).base
        for a in cp.AXES
    )
    nx, ny, nz = grid.shape
    # A stencil covers its lowest node and the two above it.
    below = jnp.full((nx, ny), nz, jnp.int32).at[bx, by].min(bz - down)
    above = jnp.full((nx, ny), -1, jnp.int32).at[bx, by].max(bz + 2 + up)
    padding = (2 + up, down)
    size = 1 + sum(padding)
    for axis in range(2):
        window = tuple(size if a == axis else 1 for a in range(2))
        pads = tuple(padding if a == axis else (0, 0) for a in range(2))
        below = jax.lax.reduce_window(below, jnp.int32(nz), jax.lax.min, window, (1, 1), pads)
        above = jax.lax.reduce_window(above, jnp.int32(-1), jax.lax.max, window, (1, 1), pads)
    lowest, highest = jnp.maximum(below, 0).reshape(-1), jnp.minimum(above, nz - 1).reshape(-1)
    return lowest, jnp.maximum(highest - lowest + 1, 0)


def _position(grid: Grid, index: tuple[Array, Array, Array], dtype) -> Vec3:
    return cp.vector(lambda a: grid.origin[a] + grid.spacing * index[a].astype(dtype))
