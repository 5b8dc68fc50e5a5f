"""Functions whose derivatives keep only the inputs; value, JVP and VJP are one equation each in a jaxpr."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from rewax.lowering.linear_primitive import Arrays, Rule, linear_call, no_transpose
from rewax.types import Array

T = TypeVar("T")


def recomputed(function: Callable[..., T], derivative_of: Callable[..., T] | None = None) -> Callable[..., T]:
    """``function`` with its forward and reverse derivative as one operation each that evaluates it again.

    What ``jax.checkpoint`` does for memory this does too. In addition the function is traced once for its value and
    once for its derivative, where the program around it would be linearised, transposed and batched equation by
    equation: for a simulation inside a policy gradient that is most of the time before compilation.

    Args:
      function: pure, from pytrees to a pytree of floating-point arrays. Everything that varies must be an argument.
      derivative_of: what to differentiate instead, called as ``derivative_of(result, *args)`` where ``result`` is
        ``function(*args)``. Its derivative by ``args`` must be that of ``function``. For the result of an iteration,
        the implicit function theorem gives it without running the iteration again. None: ``function`` itself.

    Gradient: exact, forward and reverse, once (no second derivatives).
    """

    @functools.wraps(function)
    def call(*args: Any) -> T:
        arrays, treedef, constants = split_arguments(args)
        return run_program(Program(RECOMPUTED, function, derivative_of, treedef, constants), arrays)

    return call


class Rules(NamedTuple):
    """How a ``Program`` and its derivatives are evaluated."""

    value: Rule
    tangent: Rule
    cotangent: Rule


class Program(NamedTuple):
    """A function of flat arrays, under any number of ``vmap``."""

    passes: Rules
    function: Callable[..., Any]
    derivative_of: Callable[..., Any] | None
    treedef: Any
    constants: tuple[Any, ...]
    """For each leaf of the arguments: type, value and text if it is a Python number, None if it is an array."""
    varies: tuple[bool, ...] = ()
    """Of a pointwise function: which of the arrays have an axis of elements, the last one."""
    perturbed: tuple[bool, ...] = ()
    """Which of the arrays have a derivative."""
    batches: tuple[tuple[bool, ...], ...] = ()
    """For each vmap, innermost first: which of the arrays have its axis."""

    def batched(self, which: tuple[bool, ...]) -> "Program":
        return self._replace(batches=(*self.batches, which))

    def arguments(self, arrays: Arrays) -> Any:
        rest = iter(arrays)
        return jax.tree.unflatten(self.treedef, [next(rest) if c is None else c[1] for c in self.constants])

    def apply(self, arrays: Arrays) -> Any:
        return self.function(*self.arguments(arrays))

    def results(self, arrays: Sequence[Array]) -> Any:
        """Structure, shapes and types of what the function returns."""
        shapes = tuple((a.shape, a.dtype, bool(a.weak_type)) for a in map(jax.typeof, arrays))
        return _results(self._replace(perturbed=()), shapes, jnp.result_type(float))

    def under_vmap(self, function: Callable[[Arrays, Arrays], Arrays]) -> Callable[[Arrays, Arrays], Arrays]:
        """A function of (arrays, further arrays); the further ones have every batch axis."""
        for which in self.batches:
            function = jax.vmap(function, in_axes=(tuple(0 if b else None for b in which), 0))
        return function

    def of_perturbed(self, arrays: Arrays) -> tuple[Callable[..., Arrays], Arrays]:
        """What to differentiate, as a function of the perturbed arrays alone, and their values."""
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
    """What the program's function returns. Gradient: by the program's rules."""
    return jax.tree.unflatten(jax.tree.structure(program.results(arrays)), _call(program, *arrays))


def split_arguments(args: Any) -> tuple[list[Array], Any, tuple[Any, ...]]:
    """Arrays of a pytree, and what a ``Program`` says of the rest: its structure and its Python numbers."""
    leaves, treedef = jax.tree.flatten(args)
    # Python numbers stay what they are: as arrays they would take part in the promotion of types.
    # With type and text: 1, 1.0 and True are equal, and so are 0.0 and -0.0, but they make different programs.
    constants = tuple(
        (type(leaf), leaf, repr(leaf)) if isinstance(leaf, (bool, int, float)) else None for leaf in leaves
    )
    arrays = [jnp.asarray(leaf) for leaf, c in zip(leaves, constants, strict=True) if c is None]
    return arrays, treedef, constants


@functools.lru_cache(maxsize=1024)
def _results(program: Program, shapes: tuple, precision: Any) -> Any:
    del precision  # cache key only: jax_enable_x64
    arrays = [jax.ShapeDtypeStruct(shape, dtype, weak_type=weak) for shape, dtype, weak in shapes]
    return jax.eval_shape(program.apply, arrays)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _call(program: Program, *arrays: Array) -> Arrays:
    like = jax.tree.leaves(program.results(arrays))
    return linear_call(program.passes.value, no_transpose, program, arrays, (), like=like)


def _call_jvp(program: Program, arrays: Arrays, tangents: Arrays) -> tuple[Arrays, Arrays]:
    perturbed = tuple(not isinstance(t, SymbolicZero) and t.dtype != jax.dtypes.float0 for t in tangents)
    program = program._replace(perturbed=perturbed)
    linear = [t for t, p in zip(tangents, perturbed, strict=True) if p]
    out = _call(program._replace(perturbed=()), *arrays)
    known = () if program.derivative_of is None else tuple(out)
    forward, reverse = program.passes.tangent, program.passes.cotangent
    return out, linear_call(forward, reverse, program, (*arrays, *known), linear, like=out)


_call.defjvp(_call_jvp, symbolic_zeros=True)


def _value(program: Program, arrays: Arrays, nothing: Arrays) -> Arrays:
    return program.under_vmap(lambda arrays, _: tuple(jax.tree.leaves(program.apply(arrays))))(arrays, nothing)


def _tangent(program: Program, arrays: Arrays, tangents: Arrays) -> Arrays:
    def tangent(arrays: Arrays, tangents: Arrays) -> Arrays:
        function, values = program.of_perturbed(arrays)
        return jax.jvp(function, values, tangents)[1]

    return program.under_vmap(tangent)(arrays, tangents)


def _cotangent(program: Program, arrays: Arrays, cotangents: Arrays) -> Arrays:
    def cotangent(arrays: Arrays, cotangents: Arrays) -> Arrays:
        function, values = program.of_perturbed(arrays)
        return jax.vjp(function, *values)[1](cotangents)

    return program.under_vmap(cotangent)(arrays, cotangents)


RECOMPUTED = Rules(_value, _tangent, _cotangent)
