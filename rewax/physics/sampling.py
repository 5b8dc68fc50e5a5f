"""Where particles start: boxes filled at random or regularly."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rewax.types import Array, Key


def sample_box(key: Key, center: Array | Sequence[float], size: Array | Sequence[float], num: int) -> Array:
    """Uniformly random points in a box.

    Args:
      key: PRNG key.
      center: middle of the box [m], shape (3,).
      size: its edges along x, y, z [m], shape (3,).
      num: number of points; each stands for the volume prod(size) / num.

    Returns:
      Positions [m], shape (num, 3).

    Gradient: exact with respect to center and size, which move and stretch the points.

    Example:
      >>> x = sample_box(jax.random.key(0), (0.5, 0.1, 0.5), (0.2, 0.2, 0.2), 1000)
    """
    center, size = jnp.asarray(center), jnp.asarray(size)
    dtype = jnp.result_type(center, size, float)
    unit = jax.random.uniform(key, (num, 3), dtype, -0.5, 0.5)
    return center[None].astype(dtype) + size[None].astype(dtype) * unit


def fill_box(center: Sequence[float], size: Sequence[float], spacing: float) -> np.ndarray:
    """Points of a regular lattice that fills a box, symmetric about its centre.

    Each edge is cut into the whole number of equal intervals that is closest to edge / spacing (at least one), with
    a point in the middle of each: every point stands for the same volume, prod(size) / num_points.

    Args:
      center: middle of the box [m], shape (3,).
      size: its edges along x, y, z [m], shape (3,), > 0.
      spacing: wished distance of neighbouring points [m], > 0. Half the grid's spacing gives eight particles per cell.

    Returns:
      Positions [m], float64 of shape (num_points, 3), z varying fastest.

    Raises:
      ValueError: a spacing or an edge that is not positive.

    Example:
      >>> fill_box((0.5, 0.1, 0.5), (0.2, 0.2, 0.2), 0.1).shape
      (8, 3)
    """
    if not spacing > 0:
        raise ValueError(f"spacing is {spacing}, but must be positive: give the distance of neighbours in metres")
    if not np.all(np.asarray(size) > 0):
        raise ValueError(f"size is {tuple(size)}, but must be positive: give the three edges of the box in metres")
    counts = [max(1, round(edge / spacing)) for edge in size]
    axes = [
        middle + edge * ((np.arange(n) + 0.5) / n - 0.5) for middle, edge, n in zip(center, size, counts, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


__all__ = ["fill_box", "sample_box"]
