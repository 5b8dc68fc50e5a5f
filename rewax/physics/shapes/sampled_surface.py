"""Triangle meshes of sampled distances and height fields, for pictures."""

import functools
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from jax.core import Tracer

from rewax.types import Array, Scalar

Numbers = Array | np.ndarray
MAX_NODES = 64
"""Largest number of nodes along an axis; finer grids are drawn from every second node, every third, ..."""


def sampled_surface(values: Numbers, origin: Numbers, spacing: Scalar) -> tuple[np.ndarray, np.ndarray] | None:
    """The surface of a sampled distance (marching cubes, Lorensen and Cline 1987), cached by values.

    Args:
      values, origin, spacing: those of a ``SampledDistance``.

    Returns:
      Vertices in the shape's frame [m], float32 of shape (num_vertices, 3), and triangles, indices of shape
      (num_triangles, 3), counter-clockwise seen from outside. None without scikit-image, for traced values and for
      a grid that contains no surface.

    Gradient: none.
    """
    if any(isinstance(number, Tracer) for number in (values, origin, spacing)):
        return None
    coarse, step = _coarse(np.asarray(values, np.float32))
    return _surface(coarse.tobytes(), coarse.shape, np.asarray(origin, np.float64).tobytes(), step * float(spacing))


def height_surface(heights: Numbers, origin: Numbers, spacing: Scalar) -> tuple[np.ndarray, np.ndarray] | None:
    """The surface of a height field over its grid, cached by values.

    Args:
      heights, origin, spacing: those of a ``HeightField``.

    Returns:
      Vertices in the shape's frame [m], float32 of shape (num_nodes, 3), and triangles, indices of shape
      (num_triangles, 3), counter-clockwise seen from above. None for traced values.

    Gradient: none.
    """
    if any(isinstance(number, Tracer) for number in (heights, origin, spacing)):
        return None
    coarse, step = _coarse(np.asarray(heights, np.float32))
    return _ground(coarse.tobytes(), coarse.shape, np.asarray(origin, np.float64).tobytes(), step * float(spacing))


def _coarse(values: np.ndarray) -> tuple[np.ndarray, int]:
    """Values at every n-th node, with at most ``MAX_NODES`` per axis, and n."""
    step = -(-(max(values.shape) - 1) // (MAX_NODES - 1))
    # If n does not divide the number of cells, the last node's value is used beyond the grid.
    nodes = (np.minimum(np.arange(0, n - 1 + step, step), n - 1) for n in values.shape)
    return np.ascontiguousarray(values[np.ix_(*nodes)]), step


@functools.lru_cache(maxsize=64)
def _ground(heights: bytes, shape: tuple[int, int], origin: bytes, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    x, z = (np.arange(n) * spacing + o for n, o in zip(shape, np.frombuffer(origin), strict=True))
    x, z = np.meshgrid(x, z, indexing="ij")
    vertices = np.stack([x, np.frombuffer(heights, np.float32).reshape(shape), z], axis=-1).reshape(-1, 3)
    nodes = np.arange(x.size).reshape(shape)
    a, b, c, d = nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]
    triangles = np.stack([a, b, c, c, b, d], axis=-1).reshape(-1, 3)
    return vertices.astype(np.float32), triangles


@functools.lru_cache(maxsize=64)
def _surface(
    values: bytes, shape: tuple[int, ...], origin: bytes, spacing: float
) -> tuple[np.ndarray, np.ndarray] | None:
    marching_cubes = _marching_cubes()
    if marching_cubes is None:
        return None
    distance, margin = _closed(np.frombuffer(values, np.float32).reshape(shape).copy(), spacing)
    if not distance.min() < 0.0 < distance.max():
        return None
    vertices, triangles, _, _ = marching_cubes(distance, 0.0, spacing=(spacing,) * 3, allow_degenerate=False)
    return (vertices - margin * spacing + np.frombuffer(origin)).astype(np.float32), triangles


@functools.cache
def _marching_cubes() -> Callable[..., Any] | None:
    """scikit-image's function; None, with one warning, if it is missing."""
    try:
        from skimage.measure import marching_cubes
    except ImportError:
        warnings.warn(
            "shapes given by their distance alone are left out of pictures: they need scikit-image, "
            "pip install 'rewax[surfaces]'",
            stacklevel=2,
        )
        return None
    return marching_cubes


def _closed(distance: np.ndarray, spacing: float) -> tuple[np.ndarray, int]:
    """Values on a grid extended beyond the solid, and the number of nodes added on each side."""
    inner = distance[1:-1, 1:-1, 1:-1]
    deepest = -float(np.where(np.pad(np.zeros(inner.shape, bool), 1, constant_values=True), distance, np.inf).min())
    if deepest < 0.0:
        return distance, 0
    margin = int(deepest / spacing) + 1
    beyond = [np.pad(np.zeros(n), margin, mode="linear_ramp", end_values=margin) for n in distance.shape]
    away = np.sqrt(sum(cells * cells for cells in np.meshgrid(*beyond, indexing="ij")))
    return np.pad(distance, margin, mode="edge") + spacing * away, margin
