"""Triangle mesh of any shape's surface, from its distance at the nodes of a grid."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax.physics.numerics import components as cp
from rewax.physics.shapes.sampled_surface import MAX_NODES, sampled_surface
from rewax.physics.shapes.solid import Solid, corners_of, distance_to

_MARGIN = 2
"""Cells of the grid beyond the bounding box on each side."""


def distance_surface(shape: Solid) -> tuple[np.ndarray, np.ndarray] | None:
    """The surface of a bounded shape (marching cubes, Lorensen and Cline 1987), cached by sizes.

    Args:
      shape: a pytree of arrays.

    Returns:
      Vertices in the shape's frame [m], float32 of shape (num_vertices, 3), and triangles, indices of shape
      (num_triangles, 3), counter-clockwise seen from outside. None without scikit-image, for traced sizes and for
      a distance that is nowhere negative. Parts thinner than 1/60 of the bounding box's longest edge may be missing.

    Gradient: none.
    """
    leaves, structure = jax.tree.flatten(shape)
    if any(isinstance(leaf, Tracer) for leaf in leaves):
        return None
    arrays = [np.asarray(leaf) for leaf in leaves]
    return _surface(structure, tuple((a.tobytes(), a.dtype.str, a.shape) for a in arrays))


@functools.lru_cache(maxsize=64)
def _surface(structure: Any, leaves: tuple) -> tuple[np.ndarray, np.ndarray] | None:
    numbers = [np.frombuffer(data, dtype).reshape(shape) for data, dtype, shape in leaves]
    # The caller may be tracing a program; the distance must be evaluated at once.
    with jax.ensure_compile_time_eval():
        shape = jax.tree.unflatten(structure, [jnp.asarray(n) for n in numbers])
        lower, upper = (np.asarray(corner, np.float64) for corner in corners_of(shape))
        spacing = float(np.max(upper - lower)) / (MAX_NODES - 1 - 2 * _MARGIN)
        counts = np.ceil((upper - lower) / spacing - 1e-9).astype(int) + 1 + 2 * _MARGIN
        axes = [
            m + spacing * (np.arange(n) - 0.5 * (n - 1)) for m, n in zip(0.5 * (lower + upper), counts, strict=True)
        ]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        values, _ = distance_to(shape, cp.vector(lambda i: jnp.asarray(nodes[:, i], float)))
        values = np.asarray(values, np.float32).reshape(counts)
    return sampled_surface(values, np.array([axis[0] for axis in axes]), spacing)


__all__ = ["distance_surface"]
