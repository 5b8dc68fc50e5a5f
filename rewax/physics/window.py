"""Which part of a grid takes part in a step: a moving box around the body, and in it the nodes near particles."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewax.physics import components as cp
from rewax.physics.components import Vec3
from rewax.physics.grid import Grid
from rewax.physics.kernels import quadratic_bspline
from rewax.physics.materialize import materialize
from rewax.types import Array

REACH = 1
"""Cells that a particle may move along an axis within one step when a scene lists its active nodes."""


class Window(NamedTuple):
    """The box of nodes where one step takes place; coordinates in it start at its first node."""

    grid: Grid
    """Its nodes, in its own coordinates."""
    first: Array
    """Index of its first node in the whole grid, shape (3,), int32."""
    origin: Array
    """Position of its first node [m], shape (3,)."""


class Nodes(NamedTuple):
    """The nodes of a window on which velocities are computed; all others have velocity zero."""

    flat: Array | None
    """Flat index of each in the window, shape (num_nodes,), int32; the window's number of nodes where a place is not
    used. None: all of them, in order."""
    index: tuple[Array, Array, Array]
    """Index of each in the whole grid along x, y, z, arrays (num_nodes,), int32."""
    position: Vec3
    """Position of each in the window's coordinates [m], arrays (num_nodes,)."""


def place_window(grid: Grid, shape: tuple[int, int, int] | None, x: Array) -> Window:
    """A window of the given shape (None: the whole grid) centred on the body.

    Args:
      grid: the whole grid.
      shape: nodes along x, y, z.
      x: particle positions [m], shape (num_particles, 3). Gradient: none.
    """
    shape = shape or grid.shape
    x = jax.lax.stop_gradient(x)
    middle = 0.5 * (x.min(0) + x.max(0))
    # Stencils reach equally far below and above a particle, so the middle of the nodes goes to the body's.
    cells = (middle - jnp.asarray(grid.origin, x.dtype)) / grid.spacing - 0.5 * (jnp.asarray(shape, x.dtype) - 1.0)
    last = jnp.asarray(grid.shape, jnp.int32) - jnp.asarray(shape, jnp.int32)
    first = jnp.clip(jnp.round(cells).astype(jnp.int32), 0, last)
    origin = jnp.asarray(grid.origin, x.dtype) + grid.spacing * first.astype(x.dtype)
    return Window(Grid(shape=shape, spacing=grid.spacing), first, origin)


def list_nodes(window: Window, x: Array, max_nodes: int | None) -> Nodes:
    """The nodes that particles can touch while each moves by at most ``REACH`` cells along every axis.

    Args:
      window: where.
      x: particle positions in the window's coordinates [m], shape (num_particles, 3). Gradient: none.
      max_nodes: how many the list holds; further ones are left out (see ``count_nodes``). None: all nodes.
    """
    grid = window.grid
    if max_nodes is None:
        flat, listed = None, jnp.arange(grid.num_nodes, dtype=jnp.int32)
    else:
        (flat,) = jnp.nonzero(_touched(grid, x).reshape(-1), size=max_nodes, fill_value=grid.num_nodes)
        flat = listed = flat.astype(jnp.int32)
    stride_x, stride_y, _ = grid.strides
    index = (listed // stride_x, (listed // stride_y) % grid.shape[1], listed % stride_y)
    position = cp.vector(lambda a: grid.spacing * index[a].astype(x.dtype))
    return materialize(Nodes(flat, cp.vector(lambda a: window.first[a] + index[a]), position))


def count_nodes(window: Window, x: Array) -> Array:
    """How many nodes ``list_nodes`` has to hold, shape (), int32."""
    return jnp.sum(_touched(window.grid, x), dtype=jnp.int32)


def _touched(grid: Grid, x: Array) -> Array:
    """Whether each node is in reach of a particle, shape grid.shape, bool."""
    x = jax.lax.stop_gradient(x)
    lowest = tuple(
        quadratic_bspline(x[:, a], origin=grid.origin[a], spacing=grid.spacing, num_nodes=grid.shape[a]).base
        for a in cp.AXES
    )
    mask = jnp.zeros(grid.shape, bool).at[lowest].set(True)
    for axis in cp.AXES:
        # A stencil covers its lowest node and the two above it.
        before, after = 2 + REACH, REACH
        width = [(before, after) if a == axis else (0, 0) for a in cp.AXES]
        padded = jnp.pad(mask, width)
        shifts = [jax.lax.slice_in_dim(padded, k, k + grid.shape[axis], axis=axis) for k in range(before + after + 1)]
        mask = functools.reduce(jnp.logical_or, shifts)
    return mask
