"""Active nodes of a step: the nodes that particles can reach, listed column by column."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.lowering.linear_primitive import Arrays, ByPlatform, linear_call, no_transpose
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.splines import quadratic_bspline
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.types import Array

REACHES = (0.5, 1.0)
"""Legal values of ``reach``: cells that a particle may move along an axis while a list of nodes is valid."""


class ActiveNodes(NamedTuple):
    """A list of nodes, ordered by column along z. A column holds all nodes from its lowest to its highest."""

    offset: Array
    """List index minus index along z, for each column, shape (num_columns,), int32."""
    index: tuple[Array, Array, Array]  # pyright: ignore[reportIncompatibleMethodOverride]
    """Index of each node along x, y, z, arrays (num_active,), int32; meaningless in unused slots."""
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
      num_active: length of the list, at least 3; further nodes are left out (see ``count_nodes``).
      reach: in cells, one of ``REACHES``.
    """
    like = [jax.ShapeDtypeStruct((n,), jnp.int32) for n in (grid.num_columns, num_active, num_active)]
    columns = _columns(grid, x, reach)
    offset, column, z = linear_call(_LIST, no_transpose, (grid, num_active), columns, (), like=like)
    index = (column // grid.shape[1], column % grid.shape[1], z)
    return materialize(ActiveNodes(offset, index, _position(grid, index, x.dtype)))


def count_nodes(grid: Grid, x: Array, *, reach: float = 1.0) -> Array:
    """Number of nodes that particles can touch in a step: the least ``max_active_nodes``, shape (), int32.

    Args:
      grid: all nodes.
      x: particle positions at the beginning of the step [m], shape (num_particles, 3).
      reach: cells that a particle may move along an axis within the step, 0.5 or 1.

    Gradient: none.
    """
    return jnp.sum(_columns(grid, x, reach)[1], dtype=jnp.int32)


def _columns(grid: Grid, x: Array, reach: float) -> Arrays:
    """Lowest active node and number of active nodes, for each column along z.

    The lowest node of an empty column is ``grid.shape[2]``.
    """
    like = [jax.ShapeDtypeStruct((grid.num_columns,), jnp.int32)] * 2
    return linear_call(_COLUMNS, no_transpose, (grid, reach), (jax.lax.stop_gradient(x),), (), like=like)


# --- On a CPU: few operations -----------------------------------------------------------------------------------------


def _columns_on_cpu(static: tuple[Grid, float], residuals: Arrays, linear: Arrays) -> Arrays:
    del linear
    return _batched(functools.partial(_columns_by_axis, *static), residuals, 2)


def _list_on_cpu(static: tuple[Grid, int], residuals: Arrays, linear: Arrays) -> Arrays:
    del linear
    return _batched(functools.partial(_list_by_search, *static), residuals, 1)


def _batched(one: Callable[..., Arrays], arrays: Arrays, ndim: int) -> Arrays:
    """Apply ``one``, a function of arrays with ``ndim`` axes, to arrays with further leading axes."""
    for _ in range(arrays[0].ndim - ndim):
        one = jax.vmap(one)
    return one(*arrays)


def _columns_by_axis(grid: Grid, reach: float, x: Array) -> Arrays:
    bx, by, bz = _lowest_nodes(grid, reach, x)
    nx, ny, nz = grid.shape
    down, up, _ = _margins(reach)
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


def _list_by_search(grid: Grid, num_active: int, lowest: Array, count: Array) -> Arrays:
    """Offset of each column, and the column and index along z of each listed node."""
    end = jnp.cumsum(count, dtype=jnp.int32)
    offset = end - count - lowest
    slot = jnp.arange(num_active, dtype=jnp.int32)
    column = jnp.searchsorted(end, slot, side="right").astype(jnp.int32)
    column = jnp.minimum(column, grid.num_columns - 1)
    return offset, column, jnp.clip(slot - offset[column], 0, grid.shape[2] - 1)


# --- On a GPU: few kernels --------------------------------------------------------------------------------------------


def _columns_on_gpu(static: tuple[Grid, float], residuals: Arrays, linear: Arrays) -> Arrays:
    """One scatter-min and one window-min for both ends of the columns, with the highest node negated."""
    del linear
    (grid, reach), (x,) = static, residuals
    batch, (nx, ny, nz) = x.shape[:-2], grid.shape
    down, up, _ = _margins(reach)
    bx, by, bz = (a.reshape(-1, a.shape[-1]) for a in _lowest_nodes(grid, reach, x))
    environment = jax.lax.broadcasted_iota(jnp.int32, bx.shape, 0)
    column = (environment * nx + bx) * ny + by
    ends = jnp.broadcast_to(jnp.asarray([nz, 1], jnp.int32), (len(bx) * nx * ny, 2))
    found = jnp.stack([bz - down, -(bz + 2 + up)], axis=-1)
    ends = ends.at[column.reshape(-1)].min(found.reshape(-1, 2), mode="promise_in_bounds", wrap_negative_indices=False)
    padding = (2 + up, down)
    size = 1 + sum(padding)
    ends = jax.lax.reduce_window(
        ends.reshape(-1, nx, ny, 2),
        jnp.int32(nz),
        jax.lax.min,
        (1, size, size, 1),
        (1, 1, 1, 1),
        ((0, 0), padding, padding, (0, 0)),
    ).reshape(*batch, nx * ny, 2)
    lowest, highest = jnp.maximum(ends[..., 0], 0), jnp.minimum(-ends[..., 1], nz - 1)
    return lowest, jnp.maximum(highest - lowest + 1, 0)


def _list_on_gpu(static: tuple[Grid, int], residuals: Arrays, linear: Arrays) -> Arrays:
    """``_list_by_search`` as a scatter from all nodes of the grid: a search would be a loop of kernels."""
    del linear
    (grid, num_active), (lowest, count) = static, residuals
    batch, (nx, ny, nz) = lowest.shape[:-1], grid.shape
    lowest, count = (a.reshape(-1, nx * ny) for a in (lowest, count))
    end = _cumulative(count.reshape(-1, nx, ny)).reshape(count.shape)
    offset = end - count - lowest
    # Unused slots hold what the search gives there.
    slot = jnp.arange(num_active, dtype=jnp.int32)
    nodes = (nx * ny - 1) * nz + jnp.clip(slot - offset[:, -1:], 0, nz - 1)
    shape = (len(count), nx * ny, nz)
    environment, column, z = (jax.lax.broadcasted_iota(jnp.int32, shape, axis) for axis in range(3))
    to = offset[..., None] + z
    listed = (z >= lowest[..., None]) & (to < jnp.minimum(end, num_active)[..., None])
    node = column * nz + z
    nowhere = nodes.size + environment * grid.num_nodes + node  # out of bounds and different for each node
    to = jnp.where(listed, environment * num_active + to, nowhere).reshape(-1)
    update = {"mode": "drop", "unique_indices": True, "wrap_negative_indices": False}
    nodes = nodes.reshape(-1).at[to].set(node.reshape(-1), **update)
    return tuple(a.reshape(*batch, -1) for a in (offset, nodes // nz, nodes % nz))


def _cumulative(a: Array) -> Array:
    """Cumulative sum over the last two axes, int32, as two masked sums: XLA's is a sequence of many kernels."""
    rows, columns = (jnp.arange(n) for n in a.shape[-2:])
    earlier_rows = jnp.sum(jnp.where((rows < rows[:, None])[..., None], a[..., None, :, :], 0), (-2, -1), jnp.int32)
    within_row = jnp.sum(jnp.where(columns <= columns[:, None], a[..., None, :], 0), -1, jnp.int32)
    return within_row + earlier_rows[..., None]


# --- On both ----------------------------------------------------------------------------------------------------------

_COLUMNS = ByPlatform(cpu=_columns_on_cpu, other=_columns_on_gpu)
_LIST = ByPlatform(cpu=_list_on_cpu, other=_list_on_gpu)


def _margins(reach: float) -> tuple[int, int, float]:
    """Extra nodes below and above a particle's stencil, and a downward shift of the particle in cells.

    Half a cell of reach shifts the particle down by half a cell and adds one node above.
    """
    down = int(reach)
    half = reach - down
    return down, down + int(2.0 * half), half


def _lowest_nodes(grid: Grid, reach: float, x: Array) -> Vec3:
    half = _margins(reach)[2]
    x = x - half * grid.spacing if half else x
    return cp.vector(
        lambda a: (
            quadratic_bspline(x[..., a], origin=grid.origin[a], spacing=grid.spacing, num_nodes=grid.shape[a]).base
        )
    )


def _position(grid: Grid, index: tuple[Array, Array, Array], dtype) -> Vec3:
    return cp.vector(lambda a: grid.origin[a] + grid.spacing * index[a].astype(dtype))
