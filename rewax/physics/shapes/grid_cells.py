"""Cells of a regular grid: coordinates of points in cells, and values at corners."""

from collections.abc import Sequence

import jax.numpy as jnp

from rewax.physics.numerics.clipping import clipped
from rewax.types import Array, Scalar


def locate(x: Array, origin: Scalar, spacing: Scalar, num_nodes: int) -> tuple[Array, Array, Array]:
    """Cell index along an axis, coordinate in the cell from 0 to 1, and distance beyond the grid's end in cells.

    Gradient: exact with respect to x, origin and spacing; none for the cell index.
    """
    cells = (x - origin) / spacing
    end = num_nodes - 1.0
    within = clipped(cells, 0.0, end)
    # The index is clipped again as an integer, so that NaN cannot become an index out of bounds.
    cell = jnp.clip(jnp.floor(within).astype(jnp.int32), 0, num_nodes - 2)
    return cell, within - cell.astype(x.dtype), cells - within


def take(flat: Array, index: Array) -> Array:
    """Values at indices that are in bounds. Gradient: exact."""
    return flat.at[index].get(mode="promise_in_bounds")


def check_nodes(name: str, shape: Sequence[int], axes: str) -> None:
    """Raises ValueError unless an array has the named axes, with at least two nodes along each."""
    if len(shape) != len(axes) or min(shape) < 2:
        raise ValueError(f"{name} has shape {tuple(shape)}: give at least two nodes along each of {', '.join(axes)}")


__all__ = ["check_nodes", "locate", "take"]
