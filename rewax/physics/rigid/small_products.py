"""Products of small matrices, in full precision and in a form that XLA fuses."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.linear_primitive import Arrays, ByPlatform, linear_call
from rewax.lowering.structural import structural_zeros
from rewax.physics.numerics.rotations import skew
from rewax.types import Array


def cross(a: Array, b: Array) -> Array:
    """Cross products along the last axis, of length 3."""
    return jnp.sum(skew(a) * b[..., None, :], axis=-1)


def dot(a: np.ndarray | Array, b: Array) -> Array:
    """Matrix product in full precision (accelerators round float32 products otherwise).

    Args:
      a: shape (n, k). On a GPU, products with a NumPy array become sums, which fuse with neighbouring operations.
      b: shape (k,) or (k, m).
    """
    if isinstance(a, np.ndarray):
        table = structural_zeros(jnp.asarray(a, b.dtype))
        return linear_call(_TIMES, _TRANSPOSED, _Table(b.ndim == 1), (table,), (b,))[0]
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


class _Table(NamedTuple):
    """Static data of a product of a constant matrix with a vector or a matrix, with any leading batch axes."""

    vector: bool

    def batched(self, which: tuple[bool, ...]) -> "_Table":
        del which  # the rules accept a matrix without the other operand's batch axes
        return self


def _product(static: _Table, tables: Arrays, arrays: Arrays) -> Arrays:
    (a,), (b,) = tables, arrays

    def product(a: Array, b: Array) -> Array:
        return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)

    batch = b.ndim - (1 if static.vector else 2)
    for axis in range(batch):
        product = jax.vmap(product, (0 if batch - axis <= a.ndim - 2 else None, 0))
    return (product(a, b),)


def _product_of_transposed(static: _Table, tables: Arrays, arrays: Arrays) -> Arrays:
    return _product(static, (jnp.swapaxes(tables[0], -1, -2),), arrays)


def _sums(static: _Table, tables: Arrays, arrays: Arrays) -> Arrays:
    (a,), (b,) = tables, arrays
    return (jnp.sum(a * b[..., None, :], axis=-1) if static.vector else jnp.sum(a[..., None] * b[..., None, :, :], -2),)


def _sums_of_transposed(static: _Table, tables: Arrays, arrays: Arrays) -> Arrays:
    return _sums(static, (jnp.swapaxes(tables[0], -1, -2),), arrays)


_TIMES = ByPlatform(cpu=_product, other=_sums)
_TRANSPOSED = ByPlatform(cpu=_product_of_transposed, other=_sums_of_transposed)


def select(index: np.ndarray, table: Array) -> Array:
    """``table[index]`` for a constant index, as a matrix product, so that its transpose needs no scatter."""
    onehot = np.eye(table.shape[0])[index]
    return dot(onehot, table.reshape(table.shape[0], -1)).reshape(len(index), *table.shape[1:])


def scatter(index: np.ndarray, values: Array, size: int) -> Array:
    """An array of ``size`` entries with the values, shape (len(index),), at constant indices and zeros elsewhere."""
    target = _Target(tuple(int(i) for i in index), size)
    return linear_call(_SCATTER, _GATHER, target, (), (values,))[0]


class _Target(NamedTuple):
    """Distinct indices into a vector of ``size`` entries."""

    index: tuple[int, ...]  # pyright: ignore[reportIncompatibleMethodOverride]
    size: int


def _scatter(static: _Target, residuals: Arrays, arrays: Arrays) -> Arrays:
    del residuals
    (values,) = arrays
    zeros = jnp.zeros((*values.shape[:-1], static.size), values.dtype)
    return (zeros.at[..., np.array(static.index, int)].set(values, unique_indices=True),)


def _gather(static: _Target, residuals: Arrays, arrays: Arrays) -> Arrays:
    del residuals
    return (arrays[0][..., np.array(static.index, int)],)


def _scatter_as_sums(static: _Target, residuals: Arrays, arrays: Arrays) -> Arrays:
    del residuals
    onehot = jnp.asarray(np.eye(static.size)[:, np.array(static.index, int)], arrays[0].dtype)
    return _sums(_Table(vector=True), (onehot,), arrays)


_SCATTER = ByPlatform(cpu=_scatter, other=_scatter_as_sums)
_GATHER = ByPlatform(cpu=_gather, other=_gather)


def compose(a: Array, b: Array) -> Array:
    """Products of small matrices, (..., n, n) each, as one reduction that fuses."""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def rotate(a: Array, v: Array) -> Array:
    """Products of small matrices and vectors, (..., n, n) and (..., n)."""
    return jnp.sum(a * v[..., None, :], axis=-1)
