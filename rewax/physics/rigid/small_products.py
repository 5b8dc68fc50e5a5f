"""Products of small matrices that fuse, and in full precision."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics.rotations import skew
from rewax.types import Array


def cross(a: Array, b: Array) -> Array:
    """Cross products along the last axis, of length 3."""
    return jnp.sum(skew(a) * b[..., None, :], axis=-1)


def dot(a: np.ndarray | Array, b: Array) -> Array:
    """Matrix product in full precision (accelerators round float32 products otherwise)."""
    return jnp.matmul(jnp.asarray(a, b.dtype), b, precision=jax.lax.Precision.HIGHEST)


def select(index: np.ndarray, table: Array) -> Array:
    """``table[index]`` for a constant index; as a matrix product, whose transpose needs no scatter."""
    onehot = np.eye(table.shape[0])[index]
    return dot(onehot, table.reshape(table.shape[0], -1)).reshape(len(index), *table.shape[1:])


def compose(a: Array, b: Array) -> Array:
    """Products of small matrices, (..., n, n) each; as one reduction that fuses."""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def rotate(a: Array, v: Array) -> Array:
    """Products of small matrices and vectors, (..., n, n) and (..., n)."""
    return jnp.sum(a * v[..., None, :], axis=-1)
