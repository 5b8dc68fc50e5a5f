"""Cells of a regular grid: where points lie in them, and the numbers at their corners."""

from collections.abc import Sequence

import jax.numpy as jnp

from rewax.types import Array, Scalar


def locate(x: Array, origin: Scalar, spacing: Scalar, num_nodes: int) -> tuple[Array, Array, Array]:
    """Cell along an axis, the place in it from 0 to 1, and how many cells beyond the grid's end.

    Gradient: exact with respect to x, origin and spacing; none of the cell.
    """
    cells = (x - origin) / spacing
    end = num_nodes - 1.0
    within = jnp.clip(cells, 0.0, end)
    # Clipped again as an integer: NaN must not become an index out of bounds.
    cell = jnp.clip(jnp.floor(within).astype(jnp.int32), 0, num_nodes - 2)
    return cell, within - cell.astype(x.dtype), cells - within


def take(flat: Array, index: Array) -> Array:
    """Numbers at indices that are known to be in bounds. Gradient: exact."""
    return flat.at[index].get(mode="promise_in_bounds")


def check_nodes(name: str, shape: Sequence[int], axes: str) -> None:
    """Raises ValueError unless an array of nodes has the axes that are named, with two nodes along each."""
    if len(shape) != len(axes) or min(shape) < 2:
        raise ValueError(f"{name} has shape {tuple(shape)}: give at least two nodes along each of {', '.join(axes)}")


__all__ = ["check_nodes", "locate", "take"]
