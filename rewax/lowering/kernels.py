"""Arithmetic on each particle or node alone: on a CPU one loop for all of it, and one for each of its derivatives."""

import ctypes
import functools
import hashlib
import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering import build
from rewax.lowering.codegen import KERNEL, kernel_source
from rewax.lowering.ffi_layout import batch_shape, cpu_rules, operands_of, trace_rule
from rewax.lowering.linear_primitive import Arrays
from rewax.lowering.operations import UnsupportedError
from rewax.lowering.recompute import RECOMPUTED, Program, run_program, split_arguments
from rewax.types import Array

S = TypeVar("S")
P = TypeVar("P")
T = TypeVar("T")

_CHUNK = 1024
"""Elements that a thread computes at a time, and that share a sum."""

_OPTIMIZATION = ("-O2", "-ftree-vectorize")
"""A kernel is vectors already: -O3 makes it no faster, and takes up to five times as long."""

_CALLER = build.Source("kernels", build.THREADS.read_text() + Path(__file__).with_suffix(".cc").read_text())


def pointwise(function: Callable[[S, P], T]) -> Callable[[S, P], T]:
    """``function`` of many elements, computed element by element.

    On a CPU with a C++ compiler value, forward and reverse derivative are one loop each, written by ``codegen``, built
    at the first use and kept; the derivatives keep nothing but the arguments. Without a compiler it is the function
    itself, and on a GPU XLA's kernels of it.

    Args:
      function: ``(shared, elements) -> results``, pure, defined once (it is traced once for arguments of one form).
        ``elements`` and the results are pytrees of arrays (..., num_elements), the results of floating-point;
        ``shared`` is a pytree of small arrays and numbers that all elements use. It consists of arithmetic,
        comparisons and selections, and what it does with one element it does with all: none knows another.

    Floats in ``shared`` become arrays, so that one kernel serves all of them; whole numbers are part of the program.
    Elements that are no arrays of one length and one precision are left to the function itself.

    Gradient: exact, forward and reverse, with respect to both arguments. Where there is a kernel, no second
      derivatives.
    """

    @functools.wraps(function)
    def call(shared: S, elements: P) -> T:
        dtype = _common_type(elements)
        if build.is_off() or build.compiler() is None or dtype is None:
            return function(shared, elements)
        # As arrays: a number inside the kernel would make another kernel of every number.
        shared = jax.tree.map(lambda a: jnp.asarray(a, dtype) if _adapts(a) else a, shared)
        first, *_ = split_arguments(shared)
        arrays, treedef, constants = split_arguments((shared, elements))
        varies = tuple(k >= len(first) for k in range(len(arrays)))
        return run_program(Program(POINTWISE, _spread(function), None, treedef, constants, varies), arrays)

    return call


def _common_type(elements: Any) -> Any:
    """The floating type of elements; None if there is not exactly one, or not exactly one number of elements."""
    leaves = jax.tree.leaves(elements)
    if not all(isinstance(a, (jax.Array, np.ndarray)) and a.ndim for a in leaves):
        return None
    types = {a.dtype for a in leaves if jnp.issubdtype(a.dtype, jnp.floating)}
    return types.pop() if len(types) == 1 and len({a.shape[-1] for a in leaves}) == 1 else None


def separated(parameters: T) -> tuple[T, T]:
    """Parameters that all elements share, and those of which each has its own, arrays (num_elements,).

    Both are trees like the given one, with None where the other has something; ``joined`` puts them together.
    """
    return tuple(  # type: ignore[return-value]
        jax.tree.map(lambda a, own=own: a if (jnp.ndim(a) == 1) == own else None, parameters) for own in (False, True)
    )


def joined(shared: T, own: T) -> T:
    """Inverse of ``separated``."""
    return jax.tree.map(lambda a, b: b if a is None else a, shared, own, is_leaf=lambda a: a is None)


def _adapts(number: Any) -> bool:
    """It takes the precision of what it meets."""
    if not isinstance(number, jax.Array):
        return isinstance(number, float)
    return bool(number.weak_type) and jnp.issubdtype(number.dtype, jnp.floating)


class _Target(NamedTuple):
    """A kernel that XLA can call."""

    number: int
    outputs: tuple[tuple[tuple[int, ...], Any, bool], ...]
    """Shape and type of each result for one element, and whether it is summed over all elements."""


@functools.cache
def _spread(function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """The same function, whose results all have the elements' shape."""

    def spread(shared: Any, elements: Any) -> Any:
        count = jax.tree.leaves(elements)[0].shape[-1]
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (*a.shape[:-1], count)), function(shared, elements))

    return spread


def _run(which: str, program: Program, arrays: Arrays, linear: Arrays) -> Arrays:
    """One pass: through a kernel if there is one."""
    perturbed = [v for v, p in zip(program.varies, program.perturbed, strict=False) if p]
    of_linear = {"value": [], "tangent": perturbed, "cotangent": [True] * len(linear)}[which]
    varies = (*program.varies, *of_linear)
    operands = operands_of(program, arrays, linear, varies)
    avals = tuple(o.of_one_element for o in operands)
    target = _target(which, program._replace(batches=()), avals, varies, jnp.result_type(float))
    if target is None:
        return _with_jax(which, program, arrays, linear)
    count = next(o.array.shape[-1] for o in operands if o.varies)
    batch = batch_shape(operands)
    chunks = -(-count // _CHUNK)
    sums = [(s, dtype) for s, dtype, summed in target.outputs if summed]
    own = [(s, dtype) for s, dtype, summed in target.outputs if not summed]
    shapes = [jax.ShapeDtypeStruct((*batch, *s[:-1], count), dtype) for s, dtype in own]
    if sums:
        shapes.append(jax.ShapeDtypeStruct((*batch, chunks, sum(math.prod(s) for s, _ in sums)), sums[0][1]))
    sizes = np.asarray([math.prod(batch), count, chunks, _CHUNK, *(o.step for o in operands)], np.int64)
    call = jax.ffi.ffi_call("rewax_pointwise", shapes)
    found = call(*(o.laid_out(batch) for o in operands), number=np.int64(target.number), sizes=sizes)
    mine = iter(found)
    total = iter(_split(found[-1].sum(-2), [s for s, _ in sums]) if sums else [])
    return tuple(next(total) if summed else next(mine) for _, _, summed in target.outputs)


POINTWISE = cpu_rules(_run)


def _with_jax(which: str, program: Program, arrays: Arrays, linear: Arrays) -> Arrays:
    """The same without a kernel."""
    return getattr(RECOMPUTED, which)(program, arrays, linear)


def _split(numbers: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Arrays of the given shapes that lie one after the other along the last axis."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    parts = jnp.split(numbers, ends[:-1], axis=-1)
    return [part.reshape(*part.shape[:-1], *shape) for part, shape in zip(parts, shapes, strict=True)]


def source(which: str, program: Program, avals: tuple, varies: tuple[bool, ...]) -> tuple[str, tuple]:
    """C++ of one pass, and shape, type and sum of its results as in ``_Target``.

    Raises:
      UnsupportedError: it cannot be written so.
    """
    traced = trace_rule(which, program, avals, len(program.varies))
    summed = [False] * len(traced.out_avals)
    if which == "cotangent":
        summed = [not v for v, p in zip(program.varies, program.perturbed, strict=True) if p]
    outputs = tuple((a.shape, a.dtype, s) for a, s in zip(traced.out_avals, summed, strict=True))
    return kernel_source(traced, varies, summed), outputs


@functools.lru_cache(maxsize=1024)
def _target(which: str, program: Program, avals: tuple, varies: tuple[bool, ...], precision: Any) -> _Target | None:
    """The kernel of one pass, built and known to XLA; None if there is none."""
    del precision  # which types Python's numbers become
    try:
        text, outputs = source(which, program, avals, varies)
    except UnsupportedError:
        return None
    registered = build.register(_CALLER, ("rewax_pointwise",))
    caller = build.load(_CALLER).library
    if caller is None or not registered:
        return None
    kernel, reason = build.load(build.Source("kernel", text, _OPTIMIZATION))
    if kernel is None:
        warnings.warn(f"arithmetic is computed with JAX, slower than in C++: {reason}", stacklevel=2)
        return None
    # The same in every process, for compiled programs are kept.
    number = int.from_bytes(hashlib.sha256(text.encode()).digest()[:7])
    caller.rewax_add_kernel(ctypes.c_int64(number), getattr(kernel, KERNEL))
    return _Target(number, outputs)
