"""Splits a vector into arrays."""

import itertools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering import build
from rewax.lowering.linear_primitive import Arrays, ByPlatform, linear_call
from rewax.lowering.machine import machine, register
from rewax.types import Array

_Shapes = tuple[tuple[int, ...], ...]
_TYPES = (np.dtype(np.float32), np.dtype(np.float64))


def split_vector(vector: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Splits a vector into consecutive arrays of the given shapes; its length is their total size.

    With C++ on a CPU this is one operation. XLA would make one kernel per array, which takes longer to compile than to
    run.

    Args:
      vector: shape (size,).
      shapes: of the arrays.

    Raises:
      ValueError: the sizes of the shapes do not add up to the vector's.

    Gradient: exact, forward and reverse.
    """
    shapes = tuple(shapes)
    size = sum(math.prod(shape) for shape in shapes)
    if vector.shape != (size,):
        raise ValueError(f"vector has shape {vector.shape}: give ({size},), the total size of the shapes")
    if not shapes:
        return []
    like = [jax.ShapeDtypeStruct(shape, vector.dtype) for shape in shapes]
    return list(linear_call(_SPLIT, _joined, shapes, (), (vector,), like=like))


def _split(shapes: _Shapes, nothing: Arrays, linear: Arrays) -> Arrays:
    (vector,) = linear
    ends = itertools.accumulate(math.prod(shape) for shape in shapes)
    parts = jnp.split(vector, list(ends)[:-1], axis=-1)
    return tuple(part.reshape(*vector.shape[:-1], *shape) for part, shape in zip(parts, shapes, strict=True))


def _split_in_cpp(shapes: _Shapes, nothing: Arrays, linear: Arrays) -> Arrays:
    (vector,) = linear
    if not vector.size or vector.dtype not in _TYPES or build.is_off():
        return _split(shapes, nothing, linear)
    chosen = machine(vector.dtype)
    if not register(chosen):
        return _split(shapes, nothing, linear)
    pieces = [jax.ShapeDtypeStruct((*vector.shape[:-1], *shape), vector.dtype) for shape in shapes]
    return tuple(jax.ffi.ffi_call(chosen.split_handler, pieces)(vector))


def _joined(shapes: _Shapes, nothing: Arrays, cotangents: Arrays) -> Arrays:
    batch = cotangents[0].ndim - len(shapes[0])
    return (jnp.concatenate([c.reshape(*c.shape[:batch], -1) for c in cotangents], axis=-1),)


_SPLIT = ByPlatform(cpu=_split_in_cpp, other=_split)

__all__ = ["split_vector"]
