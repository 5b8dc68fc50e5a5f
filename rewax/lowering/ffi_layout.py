"""Argument layout for FFI calls: vmapped axes become one batch axis with a stride."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from rewax import struct
from rewax.lowering.linear_primitive import Arrays, ByPlatform
from rewax.lowering.recompute import RECOMPUTED, Program, Rules
from rewax.types import Array


class Operand(NamedTuple):
    """An argument of an FFI call. Its axes are those of ``vmap``, its own, and a last axis of elements if it varies."""

    array: Array
    varies: bool
    present: tuple[bool, ...]
    """Which axes of ``vmap`` the array has, outermost first."""

    @property
    def own_shape(self) -> tuple[int, ...]:
        return self.array.shape[sum(self.present) :]

    @property
    def element_aval(self) -> tuple[tuple[int, ...], Any, bool]:
        shape = self.own_shape
        return (*shape[:-1], 1) if self.varies else shape, self.array.dtype, bool(jax.typeof(self.array).weak_type)

    @property
    def step(self) -> int:
        """Stride of the batch axis; 0: all batch elements share the array."""
        return math.prod(self.own_shape) if any(self.present) else 0

    def laid_out(self, batch: tuple[int, ...]) -> Array:
        """The array with all axes of ``vmap``, or with none."""
        if all(self.present) or not self.step:
            return self.array
        sizes = iter(self.array.shape)
        axes = tuple(next(sizes) if here else 1 for here in self.present)
        return jnp.broadcast_to(self.array.reshape(*axes, *self.own_shape), (*batch, *self.own_shape))


def cpu_rules(run: Callable[[str, Program, Arrays, Arrays], Arrays]) -> Rules:
    """Rules that ``run(name of the rule, program, arrays, linear)`` computes on a CPU, and JAX on other platforms."""
    return Rules(*(ByPlatform(functools.partial(run, which), getattr(RECOMPUTED, which)) for which in Rules._fields))


def batch_shape(operands: Sequence[Operand]) -> tuple[int, ...]:
    """Sizes of all axes of ``vmap``."""
    sizes = {}
    for operand in operands:
        axes = [axis for axis, here in enumerate(operand.present) if here]
        sizes |= zip(axes, operand.array.shape, strict=False)
    return tuple(sizes[axis] for axis in sorted(sizes))


def operands_of(program: Program, arrays: Arrays, linear: Arrays, varies: Sequence[bool]) -> list[Operand]:
    """The arguments of a rule. Its linear arguments have all axes of ``vmap``."""
    present = [tuple(batch[k] for batch in reversed(program.batches)) for k in range(len(arrays))]
    present += [(True,) * len(program.batches)] * len(linear)
    given = zip((*arrays, *linear), varies, present, strict=True)
    return [Operand(array, varying, here) for array, varying, here in given]


def trace_function(which: str, program: Program, avals: Sequence[tuple[tuple[int, ...], Any, bool]]) -> ClosedJaxpr:
    """The trace of the function that a rule evaluates or differentiates, for one batch element.

    Args:
      which: ``value``, ``tangent`` or ``cotangent``.
      program: the program.
      avals: shape, type and weak type of the rule's arguments that are not linear.
    """
    derivative_of = None if which == "value" else program.derivative_of

    def function(*arrays: Array) -> Arrays:
        if derivative_of is None:
            return tuple(jax.tree.leaves(program.apply(arrays)))
        given = program.constants.count(None)
        known = jax.tree.unflatten(jax.tree.structure(program.results(arrays[:given])), arrays[given:])
        return tuple(jax.tree.leaves(derivative_of(known, *program.arguments(arrays[:given]))))

    return _traced(function, avals)


def trace_rule(
    which: str, program: Program, avals: Sequence[tuple[tuple[int, ...], Any, bool]], function: ClosedJaxpr
) -> ClosedJaxpr:
    """The trace of a rule for one batch element.

    Args:
      which: ``value``, ``tangent`` or ``cotangent``.
      program: the program.
      avals: shape, type and weak type of the rule's arguments.
      function: the trace of the function. It is faster to differentiate than the function itself.
    """
    if which == "value":
        return function
    count = len(function.in_avals)
    arrays = (0,) * count
    perturbed = (*program.perturbed, *(False,) * (count - len(program.perturbed)))
    structure = struct.Structure.of(jax.tree.structure(arrays))
    flat = Program(program.rules, jaxpr_as_fun(function), None, structure, (None,) * count, (), perturbed)
    rule = getattr(RECOMPUTED, which)
    return _traced(lambda *a: rule(flat, a[:count], a[count:]), avals)


def _traced(function: Callable[..., Arrays], avals: Sequence[tuple[tuple[int, ...], Any, bool]]) -> ClosedJaxpr:
    structs = [jax.ShapeDtypeStruct(shape, dtype, weak_type=weak) for shape, dtype, weak in avals]
    # An empty mesh, so that avals carry no sharding.
    with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
        return jax.make_jaxpr(function)(*structs)


__all__ = ["Operand", "batch_shape", "cpu_rules", "operands_of", "trace_function", "trace_rule"]
