"""A vector cut into arrays."""

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp

from rewax.lowering import build
from rewax.lowering.linear_primitive import Arrays, ByPlatform, linear_call
from rewax.types import Array

_Shapes = tuple[tuple[int, ...], ...]
_SOURCE = build.Source(
    "split_vector", build.THREADS.read_text() + Path(__file__).with_suffix(".cc").read_text(), ("-O2",)
)


def split_vector(vector: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Arrays of the given shapes that lie one after the other in a vector, shape (number of all their elements,).

    On a CPU with a C++ compiler one operation makes all of them. XLA would make a kernel for each, which takes longer
    to compile than to run.

    Gradient: exact, forward and reverse.
    """
    shapes = tuple(shapes)
    like = [jax.ShapeDtypeStruct(shape, vector.dtype) for shape in shapes]
    return list(linear_call(_CUT, _joined, shapes, (), (vector,), like=like))


def _cut(shapes: _Shapes, nothing: Arrays, linear: Arrays) -> Arrays:
    (vector,) = linear
    ends = itertools.accumulate(math.prod(shape) for shape in shapes)
    parts = jnp.split(vector, list(ends)[:-1], axis=-1)
    return tuple(part.reshape(*vector.shape[:-1], *shape) for part, shape in zip(parts, shapes, strict=True))


def _cut_at_once(shapes: _Shapes, nothing: Arrays, linear: Arrays) -> Arrays:
    (vector,) = linear
    if not vector.size or build.is_off() or not build.register(_SOURCE, ("rewax_split_vector",)):
        return _cut(shapes, nothing, linear)
    pieces = [jax.ShapeDtypeStruct((*vector.shape[:-1], *shape), vector.dtype) for shape in shapes]
    return tuple(jax.ffi.ffi_call("rewax_split_vector", pieces)(vector))


def _joined(shapes: _Shapes, nothing: Arrays, cotangents: Arrays) -> Arrays:
    batch = cotangents[0].ndim - len(shapes[0])
    return (jnp.concatenate([c.reshape(*c.shape[:batch], -1) for c in cotangents], axis=-1),)


_CUT = ByPlatform(cpu=_cut_at_once, other=_cut)

__all__ = ["split_vector"]
