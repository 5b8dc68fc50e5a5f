"""Sums over the elements of a mesh: arithmetic on values at the corners of elements, summed at the vertices.

On a CPU value, JVP and VJP are one call each of the machine (``assembled.cc``): a block of elements gathers what it
reads, computes, and keeps its results at corners; then each vertex adds those of its elements. All threads work on one
scene. The sums have one order, so thread count and batch size do not change the result.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.lowering import build, report, stencils
from rewax.lowering.by_content import ByContent
from rewax.lowering.ffi_layout import Operand, batch_shape, cpu_rules, operands_of
from rewax.lowering.kernels import Target, as_arrays, blocks_of, broadcast, common_type, split_sums, target_of
from rewax.lowering.linear_primitive import Arrays
from rewax.lowering.recompute import RECOMPUTED, Program, run_program, split_arguments, trace_context
from rewax.lowering.stencils import Listed, Stencil

T = TypeVar("T")

_BLOCK = 512
"""Largest number of elements of a block."""


def assembled(function: Callable[[Any, Any], tuple[T, ...]]) -> Callable[[Stencil | Listed, Any, Any, Any], T]:
    """``function`` of many elements, from arrays over vertices to sums over the elements at each vertex.

    Args:
      function: ``(shared, (own, at)) -> results``, as for ``pointwise``, defined once. ``at`` has for each corner of an
        element a pytree of the form of ``fields``. ``results`` has for each corner a pytree of arrays.

    Returns:
      ``(elements, shared, own, fields) -> sums``.
      elements: the elements, or a list of them. Entries of the list beyond its last element are not read where the
        machine runs. Elsewhere reverse mode reads them, so their results must be zero.
      shared: small arrays and numbers that all elements use. own: arrays (..., num_elements).
      fields: floating-point arrays (num_vertices,). sums: of the form of ``results`` at one corner, arrays
        (num_vertices,).

    Gradient: exact, forward and reverse, with respect to ``shared``, ``own`` and ``fields``. No second derivatives in
      the machine.
    """

    return _over(function, True)


def at_elements(function: Callable[[Any, Any], T]) -> Callable[[Stencil | Listed, Any, Any, Any], T]:
    """As ``assembled``, for results of elements that are not summed: arrays (..., num_elements).

    Results of entries beyond the last element of a list have no meaning. Gradient: as for ``assembled``.
    """
    return _over(function, False)


def _over(function: Callable[[Any, Any], Any], sums: bool) -> Callable[[Stencil | Listed, Any, Any, Any], Any]:
    @functools.wraps(function)
    def call(elements: Stencil | Listed, shared: Any, own: Any, fields: Any) -> Any:
        listed = isinstance(elements, Listed)
        whole = _whole(function, elements.num_vertices if listed else elements, sums)
        given = tuple(jnp.asarray(a, jnp.int32) for a in (elements.corners, elements.count)) if listed else ()
        one_type = common_type(fields)
        if one_type is not None:
            shared = as_arrays(shared, one_type)
        if not build.is_available():
            return whole(given, shared, own, fields)
        at_vertices = all(
            jnp.shape(a) == (elements.num_vertices,) and jnp.result_type(a) == one_type for a in jax.tree.leaves(fields)
        )
        if (
            one_type is None
            or not at_vertices
            or (jax.tree.leaves(own) and not _fit(own, one_type, whole.count(given)))
        ):
            if jax.default_backend() == "cpu":
                reason = "its fields and elements are not arrays of their number and of one floating type"
                report.note(function, "value", reason)
            return whole(given, shared, own, fields)
        arrays, treedef, constants = split_arguments((given, shared, own, fields))
        kinds = [len(split_arguments(part)[0]) for part in (given, shared, own, fields)]
        varies = (False,) * sum(kinds[:2]) + (True,) * sum(kinds[2:])
        return run_program(Program(ASSEMBLED, whole, None, treedef, constants, varies), arrays)

    return call


def _fit(own: Any, dtype: Any, count: int) -> bool:
    """Whether arrays are of ``count`` elements and of the fields' floating type."""
    leaves = jax.tree.leaves(own)
    floats = {a.dtype for a in leaves if jnp.issubdtype(a.dtype, jnp.floating)}
    return all(jnp.ndim(a) and a.shape[-1] == count for a in leaves) and floats <= {dtype}


class _Whole(ByContent):
    """The function from arrays over vertices to sums, in JAX."""

    def __init__(self, function: Callable[[Any, Any], Any], static: Stencil | int, sums: bool) -> None:
        super().__init__(function, static, sums)
        self.function, self.static, self.sums = function, static, sums
        functools.update_wrapper(self, function)

    def count(self, given: tuple[Any, ...]) -> int:
        """Number of elements, or the length of their list."""
        return len(self.static) if isinstance(self.static, Stencil) else given[0].shape[-1]

    def num_corners(self, given: tuple[Any, ...]) -> int:
        return self.static.indices.shape[1] if isinstance(self.static, Stencil) else given[0].shape[-2]

    def num_vertices(self) -> int:
        return self.static.num_vertices if isinstance(self.static, Stencil) else self.static

    def __call__(self, given: tuple[Any, ...], shared: Any, own: Any, fields: Any) -> Any:
        leaves, treedef = jax.tree.flatten(fields)
        stencil = isinstance(self.static, Stencil)
        elements: Any = self.static if stencil else Listed(*given, num_vertices=self.num_vertices())
        flat = (stencils.gather if stencil else stencils.gather_listed)(elements, tuple(leaves))
        at = tuple(jax.tree.unflatten(treedef, flat[k : k + len(leaves)]) for k in range(0, len(flat), len(leaves)))
        count, results = self.count(given), self.function(shared, (own, at))
        results = jax.tree.map(lambda a: jnp.broadcast_to(a, (*a.shape[:-1], count)), results)
        if not self.sums:
            return results
        sums = (stencils.assemble if stencil else stencils.assemble_listed)(elements, tuple(jax.tree.leaves(results)))
        return jax.tree.unflatten(jax.tree.structure(results[0]), sums)


@functools.lru_cache(maxsize=1024)
def _whole(function: Callable[[Any, Any], Any], static: Stencil | int, sums: bool) -> _Whole:
    return _Whole(function, static, sums)


# --- The program of one element ---------------------------------------------------------------------------------------


class _Read(NamedTuple):
    """An argument of the program of one element."""

    argument: int
    """Index of the argument of the whole program; linear ones come after the others."""
    corner: int
    """The corner at which an element reads an array over vertices; -1: it is no such array."""


class _Slot:
    """Stands for an array in a pytree of arguments."""

    def __init__(self, *read: int) -> None:
        self.read = _Read(*read)


class _Inner(NamedTuple):
    """The program of one element, and where its arguments and results lie."""

    whole: _Whole
    program: Program
    reads: tuple[_Read, ...]


@functools.lru_cache(maxsize=1024)
def _inner(program: Program, corners: int) -> _Inner:
    whole: Any = program.function
    slots: Any = tuple(_Slot(k, -1) for k in range(len(program.varies)))
    arguments = program.arguments(slots)
    _, shared, own, fields = arguments
    at = tuple(jax.tree.map(lambda s, k=k: _Slot(s.read.argument, k), fields) for k in range(corners))
    leaves, treedef = jax.tree.flatten((shared, (own, at)))
    constants = tuple(None if isinstance(a, _Slot) else (type(a), a, repr(a)) for a in leaves)
    reads = tuple(a.read for a in leaves if isinstance(a, _Slot))
    varies = tuple(program.varies[r.argument] for r in reads)
    perturbed = tuple(program.perturbed[r.argument] for r in reads) if program.perturbed else ()
    structure = struct.Structure.of(treedef)
    one = Program(program.rules, broadcast(whole.function), None, structure, constants, varies, perturbed)
    return _Inner(whole, one, reads)


def _linear_reads(which: str, inner: _Inner, program: Program, num_linear: int, corners: int) -> list[_Read]:
    """The linear arguments of a rule of one element."""
    count, whole = len(program.varies), inner.whole
    if which == "value":
        return []
    if which == "cotangent":
        places = range(corners) if whole.sums else (-1,)
        return [_Read(count + c, k) for k in places for c in range(num_linear)]
    rank = {k: count + i for i, k in enumerate(k for k, p in enumerate(program.perturbed) if p)}
    return [_Read(rank[r.argument], r.corner) for r in inner.reads if program.perturbed[r.argument]]


# --- The call ---------------------------------------------------------------------------------------------------------


def _run(which: str, program: Program, arrays: Arrays, linear: Arrays) -> Arrays:
    """Runs a rule in the machine if possible, else with JAX."""
    if build.is_off():
        return _with_jax(which, program, arrays, linear)
    whole: Any = program.function
    listed = not isinstance(whole.static, Stencil)
    given = arrays[: 2 if listed else 0]
    corners, count = whole.num_corners(given), whole.count(given)
    plain = program._replace(batches=())
    inner = _inner(plain, corners)
    perturbed = [v for v, p in zip(program.varies, program.perturbed, strict=False) if p]
    of_linear = {"value": [], "tangent": perturbed, "cotangent": [True] * len(linear)}[which]
    operands = operands_of(program, arrays, linear, (*program.varies, *of_linear))
    reads = [*inner.reads, *_linear_reads(which, inner, program, len(linear), corners)]
    avals = tuple(operands[r.argument].element_aval for r in reads)
    varies = tuple(operands[r.argument].varies for r in reads)
    target = target_of(which, inner.program, avals, varies, trace_context())
    report.note(program.function, which, target if isinstance(target, str) else None)
    if isinstance(target, str):
        return _with_jax(which, program, arrays, linear)
    call = _Call(whole, inner, program, corners, count)
    return _called(which, call, target, [reads[k] for k in target.operands], operands)


class _Call(NamedTuple):
    whole: _Whole
    inner: _Inner
    program: Program
    corners: int
    count: int  # pyright: ignore[reportIncompatibleMethodOverride]


def _called(which: str, call: _Call, target: Target, reads: list[_Read], operands: Sequence[Operand]) -> Arrays:
    """The results of a rule in the machine."""
    batch, vertices = batch_shape(operands), call.whole.num_vertices()
    blocks, block = blocks_of(call.count, _BLOCK)
    wanted, sources = _results(which, call, len(target.outputs))
    fields = [k for k in wanted if _Read(k, 0) in sources]
    own, places = [], []
    for source, (shape, dtype, summed) in zip(sources, target.outputs, strict=True):
        if source.corner >= 0:
            places.append(-1 - (source.corner * _padded(len(fields)) + fields.index(source.argument)))
        elif not summed:
            places.append(len(own))
            own.append((source.argument, jax.ShapeDtypeStruct((*batch, *shape[:-1], call.count), dtype)))
    sums = [(s.argument, shape) for s, (shape, _, total) in zip(sources, target.outputs, strict=True) if total]
    dtype = target.outputs[0][1]
    shapes = [shape for _, shape in own] + [jax.ShapeDtypeStruct((*batch, vertices), dtype)] * len(fields)
    if sums:
        shapes.append(jax.ShapeDtypeStruct((*batch, blocks, sum(math.prod(shape) for _, shape in sums)), dtype))
    used = sorted({r.argument for r in reads})
    tables, steps = _tables(call, operands, block * blocks)
    arguments = [(used.index(r.argument), r.corner, operands[r.argument].step) for r in reads]
    head = (math.prod(batch), call.count, blocks, block, vertices, call.corners, len(reads), len(own), len(fields),
            len(tables), *steps)  # fmt: skip
    given = [a.laid_out(batch) if isinstance(a, Operand) else a for a in (*(operands[k] for k in used), *tables)]
    run = jax.ffi.ffi_call(target.machine.assembled_handler, shapes)
    found = run(*given, number=np.int64(target.number), sizes=np.array([*head, *_layout(arguments), *places], np.int64))
    results = dict(zip([k for k, _ in own] + fields, found, strict=False))
    if sums:
        totals = split_sums(found[-1].sum(-2), [shape for _, shape in sums])
        results |= zip([k for k, _ in sums], totals, strict=True)
    return tuple(results[k] for k in wanted)


def _results(which: str, call: _Call, count: int) -> tuple[list[int], list[_Read]]:
    """The results of a rule, and for each result of the program of one element the result that it belongs to."""
    if which == "cotangent":
        perturbed = call.program.perturbed
        return [k for k, p in enumerate(perturbed) if p], [r for r in call.inner.reads if perturbed[r.argument]]
    places = range(call.corners) if call.whole.sums else (-1,)
    results = range(count // len(places))
    return list(results), [_Read(r, k) for k in places for r in results]


def _padded(fields: int) -> int:
    """Fields of a vertex lie in groups of four."""
    return -(-fields // 4) * 4


def _layout(arguments: list[tuple[int, int, int]]) -> list[int]:
    """What ``Mesh`` of assembled.cc reads about arguments, given the array, the corner and the step of each."""
    fields = sorted({(array, step) for array, corner, step in arguments if corner >= 0})
    reads = [
        -1 if corner < 0 else corner * _padded(len(fields)) + fields.index((array, step))
        for array, corner, step in arguments
    ]
    arrays, steps = [array for array, *_ in arguments], [step for *_, step in arguments]
    return [len(fields), *(n for field in fields for n in field), *arrays, *reads, *steps]


def _tables(call: _Call, operands: Sequence[Operand], plane_length: int) -> tuple[list[Any], tuple[int, int]]:
    """Tables of vertices: of the elements and where each vertex finds its entries; or of a list and its length."""
    static = call.whole.static
    if not isinstance(static, Stencil):
        return [operands[0], operands[1]], (operands[0].step, operands[1].step)
    starts, entries = static.entries
    places = entries // call.count * plane_length + entries % call.count
    return [jnp.asarray(static.indices.T), jnp.asarray(starts), jnp.asarray(places.astype(np.int32))], (0, 0)


ASSEMBLED = cpu_rules(_run)


def _with_jax(which: str, program: Program, arrays: Arrays, linear: Arrays) -> Arrays:
    """Runs a rule with JAX."""
    return getattr(RECOMPUTED, which)(program, arrays, linear)


__all__ = ["ASSEMBLED", "assembled", "at_elements"]
