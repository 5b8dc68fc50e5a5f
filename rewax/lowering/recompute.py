"""Functions whose derivatives keep only the inputs; value, JVP and VJP are one equation each in a jaxpr."""

import functools
import weakref
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero

from rewax import struct
from rewax.lowering.linear_primitive import Arrays, Rule, linear_call, no_transpose
from rewax.lowering.report import name_of
from rewax.types import Array

T = TypeVar("T")


def recomputed(function: Callable[..., T], derivative_of: Callable[..., T] | None = None) -> Callable[..., T]:
    """``function`` with its JVP and VJP as one operation each, which evaluates the function again.

    It saves memory like ``jax.checkpoint``. In addition JAX traces the function once for its value and once for each
    derivative, instead of linearising, transposing and batching it equation by equation. For a simulation inside a
    policy gradient this removes most of the time before compilation.

    Args:
      function: pure, from pytrees to a pytree of floating-point arrays. Everything that varies must be an argument:
        as with ``jax.jit``, values from outside are those of the first trace, until ``jax.clear_caches()``. Traced
        values from outside raise a ValueError.
      derivative_of: function to differentiate instead, called as ``derivative_of(result, *args)`` with ``result =
        function(*args)``. Its derivative with respect to ``args`` must be that of ``function``. For the result of an
        iteration, the implicit function theorem provides it without a second iteration. None: ``function`` itself.

    Gradient: exact, forward and reverse, once (no second derivatives).
    """

    @functools.wraps(function)
    def call(*args: Any) -> T:
        arrays, treedef, constants = split_arguments(args)
        return run_program(Program(RECOMPUTED, function, derivative_of, treedef, constants), arrays)

    return call


class Rules(NamedTuple):
    """Rules that evaluate the value, JVP and VJP of a ``Program``."""

    value: Rule
    tangent: Rule
    """The JVP."""
    cotangent: Rule
    """The VJP."""


class Program(NamedTuple):
    """A function of flat arrays, under any number of ``vmap``."""

    rules: Rules
    function: Callable[..., Any]
    derivative_of: Callable[..., Any] | None
    treedef: struct.Structure
    constants: tuple[Any, ...]
    """For each leaf of the arguments: (type, value, repr) of a Python number, None for an array."""
    varies: tuple[bool, ...] = ()
    """In a pointwise program: which of the arrays have a last axis of elements."""
    perturbed: tuple[bool, ...] = ()
    """Which of the arrays have a derivative."""
    batches: tuple[tuple[bool, ...], ...] = ()
    """For each ``vmap``, innermost first: which of the arrays have its axis."""

    def batched(self, which: tuple[bool, ...]) -> "Program":
        return self._replace(batches=(*self.batches, which))

    def arguments(self, arrays: Arrays) -> Any:
        rest = iter(arrays)
        return self.treedef.unflatten(next(rest) if c is None else c[1] for c in self.constants)

    def apply(self, arrays: Arrays) -> Any:
        return self.function(*self.arguments(arrays))

    def results(self, arrays: Sequence[Array]) -> Any:
        """Structure, shapes and types of the function's result."""
        shapes = tuple((a.shape, a.dtype, bool(a.weak_type)) for a in map(jax.typeof, arrays))
        return _results(self._replace(perturbed=()), shapes, trace_context())

    def under_vmap(self, function: Callable[[Arrays, Arrays], Arrays]) -> Callable[[Arrays, Arrays], Arrays]:
        """``function(arrays, linear)`` under all batch axes; every linear array has all of them."""
        for which in self.batches:
            function = jax.vmap(function, in_axes=(tuple(0 if b else None for b in which), 0))
        return function

    def perturbed_function(self, arrays: Arrays) -> tuple[Callable[..., Arrays], Arrays]:
        """The function to differentiate, of the perturbed arrays alone, and their values."""
        count = len(self.perturbed)
        arrays, result = arrays[:count], arrays[count:]

        def function(*values: Array) -> Arrays:
            rest = iter(values)
            merged = tuple(next(rest) if p else a for a, p in zip(arrays, self.perturbed, strict=True))
            if self.derivative_of is None:
                return tuple(jax.tree.leaves(self.apply(merged)))
            known = jax.tree.unflatten(jax.tree.structure(self.results(merged)), result)
            return tuple(jax.tree.leaves(self.derivative_of(known, *self.arguments(merged))))

        return function, tuple(a for a, p in zip(arrays, self.perturbed, strict=True) if p)


def run_program(program: Program, arrays: list[Array]) -> Any:
    """The result of the program's function. Gradient: by the program's rules."""
    return jax.tree.unflatten(jax.tree.structure(program.results(arrays)), _call(program, *arrays))


def split_arguments(args: Any) -> tuple[list[Array], struct.Structure, tuple[Any, ...]]:
    """Arrays, structure and Python numbers of a pytree, as a ``Program`` stores them."""
    leaves, treedef = jax.tree.flatten(args)
    # Python numbers stay Python numbers: as arrays they would take part in type promotion.
    # Type and repr are part of the key: 1, 1.0 and True are equal, as are 0.0 and -0.0, but give different programs.
    constants = tuple(
        (type(leaf), _one_nan(leaf), repr(leaf)) if isinstance(leaf, (bool, int, float)) else None for leaf in leaves
    )
    arrays = [jnp.asarray(leaf) for leaf, c in zip(leaves, constants, strict=True) if c is None]
    return arrays, struct.Structure.of(treedef), constants


def _one_nan(number: Any) -> Any:
    """The same number, with one object for every NaN of a type: only with itself does a NaN compare equal in a key."""
    return _nan(type(number)) if number != number else number


@functools.cache
def _nan(kind: type) -> Any:
    return kind("nan")


class _Epoch:
    """A number that is another one after ``jax.clear_caches()``."""

    def __init__(self) -> None:
        self.number = 0
        self.mark: Callable[[], Any] = lambda: None

    def __call__(self) -> int:
        if self.mark() is None:
            mark = _Mark()
            self.number, self.mark = self.number + 1, weakref.ref(mark)
            with jax.disable_jit(False):  # without jit, JAX remembers no trace
                jax.eval_shape(_remember, mark)
        return self.number


class _Mark:
    """Only JAX's memory of traces holds it, so it lives until ``jax.clear_caches()``."""


@functools.partial(jax.jit, static_argnums=0)
def _remember(mark: _Mark) -> Array:
    del mark
    return jnp.zeros(())


_epoch = _Epoch()


def trace_context() -> tuple[Any, int]:
    """What a trace depends on beside its function and arguments, for the keys of caches of traces.

    It changes with ``jax_enable_x64``, and in ``jax.clear_caches()``: functions are then traced again, with the present
    values of what they close over.
    """
    return jnp.result_type(float), _epoch()


@functools.lru_cache(maxsize=1024)
def _results(program: Program, shapes: tuple, context: Any) -> Any:
    del context  # cache key only
    arrays = [jax.ShapeDtypeStruct(shape, dtype, weak_type=weak) for shape, dtype, weak in shapes]
    traced, results = jax.make_jaxpr(program.apply, return_shape=True)(arrays)
    if any(isinstance(constant, Tracer) for constant in traced.consts):
        raise ValueError(f"{name_of(program.function)} uses a traced value from outside: pass it as an argument")
    return results


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _call(program: Program, *arrays: Array) -> Arrays:
    like = jax.tree.leaves(program.results(arrays))
    return linear_call(program.rules.value, no_transpose, program, arrays, (), like=like)


def _call_jvp(program: Program, arrays: Arrays, tangents: Arrays) -> tuple[Arrays, Arrays]:
    perturbed = tuple(not isinstance(t, SymbolicZero) and jax.typeof(t).dtype != jax.dtypes.float0 for t in tangents)
    program = program._replace(perturbed=perturbed)
    linear = [jnp.asarray(t) for t, p in zip(tangents, perturbed, strict=True) if p]
    out = _call(program._replace(perturbed=()), *arrays)
    if other := [a.dtype for a in out if not jnp.issubdtype(a.dtype, jnp.inexact)]:
        raise ValueError(
            f"{name_of(program.function)} is differentiated and has a result of type {other[0]}: return floating-point "
            "arrays, and compare or count them outside"
        )
    known = () if program.derivative_of is None else tuple(out)
    forward, reverse = program.rules.tangent, program.rules.cotangent
    return out, linear_call(forward, reverse, program, (*arrays, *known), linear, like=out)


_call.defjvp(_call_jvp, symbolic_zeros=True)


def _value(program: Program, arrays: Arrays, nothing: Arrays) -> Arrays:
    return program.under_vmap(lambda arrays, _: tuple(jax.tree.leaves(program.apply(arrays))))(arrays, nothing)


def _tangent(program: Program, arrays: Arrays, tangents: Arrays) -> Arrays:
    def tangent(arrays: Arrays, tangents: Arrays) -> Arrays:
        function, values = program.perturbed_function(arrays)
        return jax.jvp(function, values, tangents)[1]

    return program.under_vmap(tangent)(arrays, tangents)


def _cotangent(program: Program, arrays: Arrays, cotangents: Arrays) -> Arrays:
    def cotangent(arrays: Arrays, cotangents: Arrays) -> Arrays:
        function, values = program.perturbed_function(arrays)
        return jax.vjp(function, *values)[1](cotangents)

    return program.under_vmap(cotangent)(arrays, cotangents)


RECOMPUTED = Rules(_value, _tangent, _cotangent)
