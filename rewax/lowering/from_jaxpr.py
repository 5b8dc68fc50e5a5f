"""Lowers traced programs to lists of scalar operations.

Small arrays are expanded into scalars, and loops of a fixed length are unrolled. Both branches of a condition are
computed, and one is selected. ``primitives`` lists the supported operations; others are refused with a reason.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr

from rewax.lowering.indexing import Values, rows
from rewax.lowering.linear_primitive import linear_call_p, run_scalar_form
from rewax.lowering.operations import ARITHMETIC, Loop, Operation, Operations, UnsupportedError, plain_type
from rewax.lowering.primitives import PRIMITIVES, Equation, select
from rewax.lowering.structural import marks_structural_zeros

_LONGEST_LOOP = 64

_CALLS = frozenset({
    "jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "remat2", "custom_jvp_call", "custom_vjp_call",
    "custom_vmap_call",
})  # fmt: skip
_IDENTITIES = frozenset(["optimization_barrier", "copy", "copy_p", "stop_gradient", "name"])
_KEEPS_CONSTANTS = frozenset([
    "select_n", "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "stack", "concatenate", *_IDENTITIES
])  # fmt: skip
_LOOP_PARAMETERS = frozenset({
    "jaxpr", "length", "reverse", "unroll", "linear", "num_consts", "num_carry", "ft_in", "ft_out", "_split_transpose",
})  # fmt: skip
_WHILE_PARAMETERS = frozenset({"cond_jaxpr", "cond_nconsts", "body_jaxpr", "body_nconsts"})


class OperationList(NamedTuple):
    """A program of scalar operations."""

    operations: list[Operation]
    outputs: list[list[int]]
    """For each result, the indices of the operations of its entries, in order."""
    dtype: np.dtype
    """The program's floating type."""
    loops: tuple[Loop, ...] = ()


def from_jaxpr(
    program: ClosedJaxpr, varies: Sequence[bool], *, most: int = 5_000, loops: bool = False
) -> OperationList:
    """The operations of a traced program of one element.

    Args:
      program: arithmetic on small arrays.
      varies: which of its arguments differ between elements.
      most: largest number of operations.
      loops: whether it may have loops without a fixed number of turns.

    Raises:
      UnsupportedError: the program cannot be lowered.
    """
    dtype = _floating_type(program)
    builder, inputs = _Builder(dtype, most, loops), []
    for k, (aval, varying) in enumerate(zip(program.in_avals, varies, strict=True)):
        kind = builder.kind_of(aval.dtype)
        if kind == "u":
            raise UnsupportedError("it takes unsigned integers")
        inputs.append(builder.array(aval.shape, lambda i, k=k, kind=kind, v=varying: builder.input(k, i, kind, v)))
    if any(np.issubdtype(a.dtype, np.floating) and a.dtype != dtype for a in program.out_avals):
        raise UnsupportedError(f"its results are of floating types other than {dtype}")
    found = builder.run(program.jaxpr, program.consts, inputs)
    outputs = [np.ravel(output).tolist() for output in found]
    return OperationList(builder.listed, outputs, dtype, tuple(builder.loops))


def _floating_type(program: ClosedJaxpr) -> np.dtype:
    types = {a.dtype for a in program.in_avals if jax.numpy.issubdtype(a.dtype, np.floating)}
    if len(types) != 1 or not types <= {np.dtype(np.float32), np.dtype(np.float64)}:
        raise UnsupportedError(f"its floating types are {sorted(map(str, types))}")
    return types.pop()


class _Builder(Operations):
    """Builds the list of a traced program's operations."""

    def __init__(self, dtype: np.dtype, most: int, has_loops: bool) -> None:
        super().__init__(dtype, most)
        self.has_loops = has_loops

    def run(self, jaxpr: Any, consts: Sequence[Any], args: Sequence[Values]) -> list[Values]:
        values: dict[Any, Values] = {}

        def read(v: Any) -> Values:
            return self.literal(np.asarray(v.val, v.aval.dtype)) if hasattr(v, "val") else values[v]

        for v, value in zip(jaxpr.constvars, consts, strict=True):
            values[v] = self.literal(np.asarray(value, plain_type(v.aval.dtype)))
        values |= zip(jaxpr.invars, args, strict=True)
        for eqn in _live(jaxpr):
            outs = self.equation(eqn, [read(v) for v in eqn.invars])
            for v, out in zip(eqn.outvars, outs, strict=True):
                if out.shape != v.aval.shape:
                    raise UnsupportedError(f"it has the operation {eqn.primitive.name} in a form that is not known")
                values[v] = out
        return [read(v) for v in jaxpr.outvars]

    def equation(self, eqn: Any, args: list[Values]) -> list[Values]:
        name, params = eqn.primitive.name, eqn.params
        if not eqn.outvars:
            raise UnsupportedError(f"it has the operation {name} without a result")
        if eqn.primitive is linear_call_p:
            if marks_structural_zeros(params["function"]):
                return [self.structural(a) for a in args]
            inner = jax.make_jaxpr(lambda *a: run_scalar_form(*a, **params))(*(v.aval for v in eqn.invars))
            return self.run(inner.jaxpr, inner.consts, args)
        if name == "scan":
            return self.scan(eqn, args)
        if name == "while" and self.has_loops:
            return self.while_loop(params, args)
        if name == "cond":
            return self.cond(params, args)
        if name == "reduce":
            return self.reduce(params, args)
        if name == "custom_linear_solve":
            return self.linear_solve(params, args)
        if name in _CALLS:
            inner = next(params[key] for key in ("jaxpr", "call_jaxpr", "call") if key in params)
            closed = hasattr(inner, "consts")
            return self.run(inner.jaxpr if closed else inner, inner.consts if closed else (), args)
        # Only constants of another precision are converted: a comparison would see rounded values.
        converts = name == "convert_element_type" and eqn.outvars[0].aval.dtype == self.dtype
        if name not in _KEEPS_CONSTANTS and not converts and any(map(self.is_foreign, (*eqn.invars, *eqn.outvars))):
            raise UnsupportedError(f"it computes with floating types other than {self.dtype}")
        if name in _IDENTITIES:
            return args
        if name in ("split", "unstack"):
            known(name, params, {"sizes", "axis", "num"})
            parts = args[0].shape[params["axis"]] if name == "unstack" else np.cumsum(params["sizes"])[:-1]
            pieces = np.split(args[0], parts, axis=params["axis"])
            return [p.squeeze(params["axis"]) for p in pieces] if name == "unstack" else pieces
        if name not in PRIMITIVES:
            raise UnsupportedError(f"it has the operation {name}")
        known(name, params, PRIMITIVES[name].parameters)
        return [PRIMITIVES[name].lower(self, Equation(name, params, eqn.outvars[0].aval), args)]

    def is_foreign(self, variable: Any) -> bool:
        """Whether a variable is of another floating type than the program."""
        dtype = variable.aval.dtype
        return jnp.issubdtype(dtype, np.floating) and dtype != self.dtype

    def scan(self, eqn: Any, args: list[Values]) -> list[Values]:
        """Unrolls a short loop."""
        params = eqn.params
        known("scan", params, _LOOP_PARAMETERS)
        length, jaxpr = params["length"], params["jaxpr"]
        if not 0 < length <= _LONGEST_LOOP:
            raise UnsupportedError(f"it has a loop of {length} turns")
        # Counted by ranks: the parameters' names differ between versions of JAX.
        num_carry = sum(len(o.aval.shape) == len(i.shape) for o, i in zip(eqn.outvars, jaxpr.out_avals, strict=True))
        num_stacked = sum(len(o.aval.shape) > len(i.shape) for o, i in zip(eqn.invars, jaxpr.in_avals, strict=True))
        last = len(args) - num_stacked
        consts, carry, given = args[: last - num_carry], args[last - num_carry : last], args[last:]
        turns = []
        for i in reversed(range(length)) if params["reverse"] else range(length):
            out = self.run(jaxpr.jaxpr, jaxpr.consts, [*consts, *carry, *(np.asarray(g[i]) for g in given)])
            carry = out[:num_carry]
            turns.append(out[num_carry:])
        if params["reverse"]:
            turns.reverse()
        return [*carry, *(np.stack(same) for same in zip(*turns, strict=True))]

    def while_loop(self, params: dict[str, Any], args: list[Values]) -> list[Values]:
        """A loop whose number of turns depends on its values."""
        known("while", params, _WHILE_PARAMETERS)
        test, turn = params["cond_jaxpr"], params["body_jaxpr"]
        last = params["cond_nconsts"] + params["body_nconsts"]
        of_test, of_turn, initial = args[: params["cond_nconsts"]], args[params["cond_nconsts"] : last], args[last:]
        return self.loop(
            initial,
            lambda carried: self.run(test.jaxpr, test.consts, [*of_test, *carried])[0],
            lambda carried: self.run(turn.jaxpr, turn.consts, [*of_turn, *carried]),
        )

    def cond(self, params: dict[str, Any], args: list[Values]) -> list[Values]:
        """Computes all branches of a condition and selects one, as ``vmap`` does."""
        known("cond", params, {"branches"})
        before = len(self.loops)
        branches = [self.run(branch.jaxpr, branch.consts, args[1:]) for branch in params["branches"]]
        if len(self.loops) > before:  # in a branch that is not chosen it might never end
            raise UnsupportedError("it has a while loop in a branch of a condition")
        return [select(self, args[0], cases) for cases in zip(*branches, strict=True)]

    def reduce(self, params: dict[str, Any], args: list[Values]) -> list[Values]:
        """Reduces several arrays together by a function of scalars."""
        known("reduce", params, {"computation", "jaxpr", "dimensions", "consts", "out_sharding"})
        jaxpr, axes, half = params["jaxpr"], params["dimensions"], len(args) // 2
        given = [rows(a, axes) for a in args[:half]]
        totals = [np.full(a.shape[1:], initial, np.int64) for a, initial in zip(given, args[half:], strict=True)]
        for index in np.ndindex(totals[0].shape):
            for k in range(len(given[0])):
                numbers = [np.asarray(a[index]) for a in (*totals, *(r[k] for r in given))]
                for total, number in zip(totals, self.run(jaxpr.jaxpr, jaxpr.consts, numbers), strict=True):
                    total[index] = number
        return totals

    def linear_solve(self, params: dict[str, Any], args: list[Values]) -> list[Values]:
        """Runs the solver of ``jax.lax.custom_linear_solve``."""
        known("custom_linear_solve", params, {"const_lengths", "jaxprs"})
        lengths, solve = params["const_lengths"], params["jaxprs"].solve
        first = lengths.matvec + lengths.vecmat
        return self.run(solve.jaxpr, solve.consts, [*args[first : first + lengths.solve], *args[sum(lengths) :]])


def _live(jaxpr: Any) -> list[Any]:
    """The equations that the results need, and those with effects. Others may have unsupported operations."""
    live, needed = [], {v for v in jaxpr.outvars if not hasattr(v, "val")}
    for eqn in reversed(jaxpr.eqns):
        if eqn.effects or not needed.isdisjoint(eqn.outvars):
            live.append(eqn)
            needed.update(v for v in eqn.invars if not hasattr(v, "val"))
    return live[::-1]


def known(name: str, params: dict[str, Any], parameters: set[str] | frozenset[str]) -> None:
    """Raises UnsupportedError if a primitive has a parameter outside ``parameters``."""
    unknown = sorted(set(params) - parameters)
    if unknown:
        raise UnsupportedError(f"it has the operation {name} with the unknown parameter {', '.join(unknown)}")


__all__ = ["ARITHMETIC", "OperationList", "UnsupportedError", "from_jaxpr"]
