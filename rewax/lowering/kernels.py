"""Pointwise arithmetic on particles or nodes: on a CPU one program of the machine each for value, JVP and VJP.

XLA's CPU compiler emits a loop and a store for every array that has two consumers. Arithmetic on the components of 3x3
matrices consists of such arrays: a hundred loops for a material law, four hundred for its derivative. They take most of
the compile time and much of the run time. The machine (``machine``) evaluates the traced program of *one* element for
blocks of a few hundred elements, whose intermediate values stay in the processor's L1 cache.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr

from rewax.lowering import build, report
from rewax.lowering.assembler import BlockBytecode, assemble_blocks
from rewax.lowering.bytecode_cache import key_of, remembered
from rewax.lowering.ffi_layout import batch_shape, cpu_rules, operands_of, trace_function, trace_rule
from rewax.lowering.from_jaxpr import from_jaxpr
from rewax.lowering.linear_primitive import Arrays
from rewax.lowering.machine import Machine, load, machine
from rewax.lowering.operations import UnsupportedError
from rewax.lowering.recompute import RECOMPUTED, Program, run_program, split_arguments, trace_context
from rewax.types import Array

S = TypeVar("S")
P = TypeVar("P")
T = TypeVar("T")

_BLOCK = 512
"""Largest number of elements of a block: enough to amortise the dispatch of instructions, few enough to keep registers
in the processor's caches. A thread computes one block at a time and keeps sums per block."""

_ALIGNMENT = 64
"""Block sizes are multiples of this, so that vectors are full on any processor."""


def pointwise(function: Callable[[S, P], T]) -> Callable[[S, P], T]:
    """``function`` of many independent elements, in C++ on a CPU.

    On a CPU the value, the forward derivative (JVP) and the reverse derivative (VJP) are one program of the machine
    each. The derivatives store only the arguments. Without the machine, and on a GPU, the function itself runs.

    Args:
      function: ``(shared, elements) -> results``, pure, defined once (it is traced once per form of arguments).
        ``elements`` and ``results`` are pytrees of arrays (..., num_elements); results are floating-point. ``shared``
        is a pytree of small arrays and numbers that all elements use. The function consists of arithmetic, comparisons
        and selections, and applies them to each element independently.

    Floats in ``shared`` become arrays of the elements' type, on every device, so that one program serves all values;
    integers are static. If elements are not arrays of one length and one precision, the function itself runs, with a
    warning.

    Gradient: exact, forward and reverse, with respect to both arguments. No second derivatives in the machine.
    """

    @functools.wraps(function)
    def call(shared: S, elements: P) -> T:
        dtype = common_type(elements)
        available = build.is_available()
        if dtype is None:
            if available and jax.default_backend() == "cpu":
                report.note(function, "value", "its elements are not arrays of one length and one floating type")
            return function(shared, elements)
        shared = as_arrays(shared, dtype)
        if not available:
            return broadcast(function)(shared, elements)
        first, *_ = split_arguments(shared)
        arrays, treedef, constants = split_arguments((shared, elements))
        varies = tuple(k >= len(first) for k in range(len(arrays)))
        return run_program(Program(POINTWISE, broadcast(function), None, treedef, constants, varies), arrays)

    return call


def common_type(elements: Any) -> Any:
    """The floating type of elements; None unless they have one floating type and one length."""
    leaves = jax.tree.leaves(elements)
    if not all(isinstance(a, (jax.Array, np.ndarray)) and a.ndim for a in leaves):
        return None
    types = {a.dtype for a in leaves if jnp.issubdtype(a.dtype, jnp.floating)}
    return types.pop() if len(types) == 1 and len({a.shape[-1] for a in leaves}) == 1 else None


def as_arrays(shared: S, dtype: Any) -> S:
    """Shared values with their floats as arrays: a static float would need a program for every value."""
    return jax.tree.map(lambda a: jnp.asarray(a, dtype) if _adapts(a) else a, shared)


def separated(parameters: T) -> tuple[T, T]:
    """Parameters that all elements share, and per-element parameters, which are arrays (num_elements,).

    Both trees have the given structure, with None in place of the other's leaves; ``joined`` merges them.
    """
    return tuple(  # type: ignore[return-value]
        jax.tree.map(lambda a, own=own: a if (jnp.ndim(a) == 1) == own else None, parameters) for own in (False, True)
    )


def joined(shared: T, own: T) -> T:
    """Inverse of ``separated``."""
    return jax.tree.map(lambda a, b: b if a is None else a, shared, own, is_leaf=lambda a: a is None)


def _adapts(number: Any) -> bool:
    """Whether a number has a weak floating type."""
    if not isinstance(number, jax.Array):
        return isinstance(number, float)
    return bool(number.weak_type) and jnp.issubdtype(number.dtype, jnp.floating)


class Target(NamedTuple):
    """A program in the machine that XLA can call."""

    machine: Machine
    number: int
    outputs: tuple[tuple[tuple[int, ...], Any, bool], ...]
    """Shape and type of each result for one element, and whether it is summed over elements."""
    operands: tuple[int, ...]
    """Indices of the arguments that it reads. XLA need not compute the others."""


@functools.lru_cache(maxsize=1024)
def broadcast(function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """The function with its results broadcast to the number of elements."""

    @functools.wraps(function)
    def broadcast(shared: Any, elements: Any) -> Any:
        count = jax.tree.leaves(elements)[0].shape[-1]
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (*a.shape[:-1], count)), function(shared, elements))

    return broadcast


def _run(which: str, program: Program, arrays: Arrays, linear: Arrays) -> Arrays:
    """Runs a rule in the machine if possible, else with JAX."""
    if build.is_off():
        return _with_jax(which, program, arrays, linear)
    perturbed = [v for v, p in zip(program.varies, program.perturbed, strict=False) if p]
    of_linear = {"value": [], "tangent": perturbed, "cotangent": [True] * len(linear)}[which]
    varies = (*program.varies, *of_linear)
    operands = operands_of(program, arrays, linear, varies)
    avals = tuple(o.element_aval for o in operands)
    target = target_of(which, program._replace(batches=()), avals, varies, trace_context())
    report.note(program.function, which, target if isinstance(target, str) else None)
    if isinstance(target, str):
        return _with_jax(which, program, arrays, linear)
    count = next(o.array.shape[-1] for o in operands if o.varies)
    batch = batch_shape(operands)
    blocks, block = blocks_of(count)
    sums = [(s, dtype) for s, dtype, summed in target.outputs if summed]
    own = [(s, dtype) for s, dtype, summed in target.outputs if not summed]
    shapes = [jax.ShapeDtypeStruct((*batch, *s[:-1], count), dtype) for s, dtype in own]
    if sums:
        shapes.append(jax.ShapeDtypeStruct((*batch, blocks, sum(math.prod(s) for s, _ in sums)), sums[0][1]))
    used = [operands[k] for k in target.operands]
    sizes = np.asarray([math.prod(batch), count, blocks, block, *(o.step for o in used)], np.int64)
    call = jax.ffi.ffi_call(target.machine.blocks_handler, shapes)
    found = call(*(o.laid_out(batch) for o in used), number=np.int64(target.number), sizes=sizes)
    mine = iter(found)
    total = iter(split_sums(found[-1].sum(-2), [s for s, _ in sums]) if sums else [])
    return tuple(next(total) if summed else next(mine) for _, _, summed in target.outputs)


POINTWISE = cpu_rules(_run)


def _with_jax(which: str, program: Program, arrays: Arrays, linear: Arrays) -> Arrays:
    """Runs a rule with JAX."""
    return getattr(RECOMPUTED, which)(program, arrays, linear)


def split_sums(numbers: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Splits the last axis into consecutive arrays of the given shapes."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    parts = jnp.split(numbers, ends[:-1], axis=-1)
    return [part.reshape(*part.shape[:-1], *shape) for part, shape in zip(parts, shapes, strict=True)]


def blocks_of(count: int, largest: int = _BLOCK) -> tuple[int, int]:
    """Number of blocks, of about equal size, and number of elements per block."""
    block = -(-count // max(-(-count // largest), 1))
    block = -(-max(block, 1) // _ALIGNMENT) * _ALIGNMENT
    return -(-count // block), block


def bytecode_of(
    which: str, program: Program, avals: tuple, varies: tuple[bool, ...], function: ClosedJaxpr | None = None
) -> tuple[BlockBytecode, np.dtype, tuple]:
    """Bytecode of a rule, its floating type, and the outputs of ``Target``.

    Raises:
      UnsupportedError: the rule cannot be lowered.
    """
    function = function or trace_function(which, program, avals[: len(program.varies)])
    traced = trace_rule(which, program, avals, function)
    summed = [False] * len(traced.out_avals)
    if which == "cotangent":
        summed = [not v for v, p in zip(program.varies, program.perturbed, strict=True) if p]
    outputs = tuple((a.shape, a.dtype, s) for a, s in zip(traced.out_avals, summed, strict=True))
    listing = from_jaxpr(traced, varies)
    types, rows = [a.dtype for a in traced.in_avals], [math.prod(a.shape) for a in traced.in_avals]
    return assemble_blocks(listing, types, rows, summed), listing.dtype, outputs


@functools.lru_cache(maxsize=1024)
def target_of(which: str, program: Program, avals: tuple, varies: tuple[bool, ...], context: Any) -> Target | str:
    """The registered bytecode of a rule, or the reason why there is none."""
    del context  # cache key only
    try:
        function = trace_function(which, program, avals[: len(program.varies)])
        key = key_of(function, "blocks", which, program.perturbed, program.varies, avals, varies)
        make = functools.partial(bytecode_of, which, program, avals, varies, function)
        bytecode, dtype, outputs = remembered(key, make)
        number, reason = load(dtype, bytecode)
    except UnsupportedError as error:
        return str(error)
    except Exception as error:  # an unforeseen failure: fall back to XLA
        return f"it could not be lowered ({type(error).__name__}: {error})"
    return reason if number is None else Target(machine(dtype), number, outputs, bytecode.operands)
