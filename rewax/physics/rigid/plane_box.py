"""Plane-box contact at the four lower corners, at any depth."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from rewax.types import Array

_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
_EARLIER = np.tri(len(_CORNERS), k=-1, dtype=bool)
"""``_EARLIER[i, j]``: corner j comes before corner i in the list."""


def plane_box(plane: Array, normal: Array, center: Array, rotation: Array, half_size: Array) -> tuple[Array, Array]:
    """Distances and points of contact of a box's four lower corners with a plane.

    Args:
      plane: a point of the plane [m], shape (3,).
      normal: unit normal out of the plane, shape (3,).
      center: center of the box [m], shape (3,).
      rotation: from the box's frame to the world's, shape (3, 3).
      half_size: half sizes of the box [m], shape (3,).

    Returns:
      Signed distances [m], shape (4,), and points halfway between corner and plane [m], shape (4, 3).

    Gradient: exact while the same corners are the lower ones; two corners that swap are equally high.
    Source: MuJoCo's plane-box collision. MJX keeps only corners within 1 mm of the deepest, so a soft box that tilts
      suddenly loses the force of its other corners.
    """
    arms = jnp.sum(rotation * (jnp.asarray(_CORNERS, half_size.dtype) * half_size)[:, None, :], axis=-1)
    height = jnp.sum(arms * normal, axis=-1)
    below = (height[None, :] < height[:, None]) | ((height[None, :] == height[:, None]) & _EARLIER)
    rank = jnp.sum(below, axis=-1)  # how many corners come before: lower ones, and of equally high ones the earlier
    onehot = (rank == np.arange(4)[:, None]).astype(arms.dtype)
    corner = center + jnp.matmul(onehot, arms, precision=jax.lax.Precision.HIGHEST)
    distance = jnp.sum((corner - plane) * normal, axis=-1)
    return distance, corner - 0.5 * distance[:, None] * normal


__all__ = ["plane_box"]
