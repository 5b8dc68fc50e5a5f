"""Traced programs as lists of operations on single numbers.

Loops and conditions have no place in such a list. Short loops are written out, and arrays, which are small, too.
"""

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from rewax.physics.numerics.linear_pass import linear_pass_p, run_elsewhere

_MOST_OPERATIONS = 5_000
_LONGEST_LOOP = 64

Values: TypeAlias = np.ndarray
"""The value of a variable: an object array of the indices of operations."""

ARITHMETIC = frozenset({
    "add", "sub", "mul", "div", "neg", "max", "min", "abs", "sign", "sqrt", "rsqrt", "cbrt", "exp", "log",
    "log1p", "expm1", "sin", "cos", "tanh", "logistic", "pow", "atan2", "floor", "ceil", "is_finite", "lt",
    "le", "gt", "ge", "eq", "ne", "and", "or", "xor", "not",
})  # fmt: skip
"""Operations on numbers, by the names of JAX's primitives."""
_OF_WHOLE = frozenset(["max", "min", "lt", "le", "gt", "ge", "eq", "ne", "select", "i_to_f", "i_to_b"])
_FOLDED = {"add": operator.add, "sub": operator.sub, "mul": operator.mul}
_OF_TRUTH = frozenset(["and", "or", "xor", "not", "eq", "ne", "select", "b_to_f", "b_to_i"])
_CALLS = frozenset(
    ["jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "remat2", "custom_jvp_call", "custom_vjp_call"]
)
_KEEPS_CONSTANTS = frozenset(
    ["select_n", "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "stack", "concatenate", "copy"]
)


class UnsupportedError(Exception):
    """A program has something that is not arithmetic on numbers of one precision; the message names it."""


class Operation(NamedTuple):
    """One number from others. Equal operations on equal operands are one."""

    name: str
    """One of ``ARITHMETIC``, ``select``, ``constant``, ``input``, or a conversion, ``b_to_f``."""
    operands: tuple[int, ...]
    """Earlier operations, by their places in the list."""
    kind: str
    """``f`` (the floating type), ``i`` (integer) or ``b`` (truth value)."""
    shared: bool
    """The same for all elements of a copy."""
    constant: Any = None
    """Of a ``constant`` its value, as text; of an ``input`` which argument it is, and the place in it."""


class StraightLine(NamedTuple):
    """A program without loops and conditions."""

    operations: list[Operation]
    outputs: list[list[int]]
    """For each result the operations that give its numbers, in order."""
    dtype: np.dtype
    """The floating type."""


def straight_line(program: ClosedJaxpr, varies: Sequence[bool]) -> StraightLine:
    """A traced program of one element.

    Args:
      program: arithmetic on small arrays.
      varies: which of its arguments differ between the elements.

    Raises:
      UnsupportedError: it has something else.
    """
    dtype = _floating_type(program)
    builder, inputs = _Builder(dtype), []
    for k, (aval, varying) in enumerate(zip(program.in_avals, varies, strict=True)):
        kind = builder.kind_of(aval.dtype)
        inputs.append(builder.array(aval.shape, lambda i, k=k, kind=kind, v=varying: builder.input(k, i, kind, v)))
    if any(np.issubdtype(a.dtype, np.floating) and a.dtype != dtype for a in program.out_avals):
        raise UnsupportedError(f"its results are of floating types other than {dtype}")
    found = builder.run(program.jaxpr, program.consts, inputs)
    outputs = [[int(value) for value in np.ravel(output)] for output in found]
    return StraightLine(builder.operations, outputs, dtype)


def _floating_type(program: ClosedJaxpr) -> np.dtype:
    types = {a.dtype for a in program.in_avals if jax.numpy.issubdtype(a.dtype, np.floating)}
    if len(types) != 1 or not types <= {np.dtype(np.float32), np.dtype(np.float64)}:
        raise UnsupportedError(f"its floating types are {sorted(map(str, types))}")
    return types.pop()


class _Builder:
    """Operations in order, each once: an operation with the operands of an earlier one is that one."""

    def __init__(self, dtype: np.dtype) -> None:
        self.dtype = dtype
        self.operations: list[Operation] = []
        self.known: dict[Operation, int] = {}

    # --- Operations ---

    def add(self, operation: Operation) -> int:
        if operation not in self.known:
            if len(self.operations) >= _MOST_OPERATIONS:
                raise UnsupportedError(f"it has more than {_MOST_OPERATIONS} operations")
            self.known[operation] = len(self.operations)
            self.operations.append(operation)
        return self.known[operation]

    def input(self, place: int, offset: int, kind: str, varying: bool) -> int:
        return self.add(Operation("input", (), kind, not varying, (place, offset)))

    def constant(self, value: Any, kind: str) -> int:
        # As text: -0.0 equals 0.0, and NaN nothing.
        number = {"f": lambda: float(value), "i": lambda: int(value), "b": lambda: bool(value)}[kind]()
        return self.add(Operation("constant", (), kind, True, repr(number)))

    def apply(self, name: str, *operands: int, kind: str | None = None) -> int:
        used = [self.operations[o] for o in operands]
        kinds = {o.kind for o in used}
        if kinds == {"i"} and name in _FOLDED and all(o.name == "constant" for o in used):  # a counter of turns
            return self.constant(_FOLDED[name](*(int(o.constant) for o in used)), "i")
        if "b" in kinds and name in ("max", "min"):
            name = {"max": "or", "min": "and"}[name]
        for of, allowed, what in (("i", _OF_WHOLE, "whole numbers"), ("b", _OF_TRUTH, "truth values")):
            if of in kinds and name not in allowed:
                raise UnsupportedError(f"it has the operation {name} of {what}")
        kind = used[0].kind if kind is None else kind
        if name in ("mul", "add") and kind == "f":  # by one, and with zero: derivatives are full of them
            neutral = "1.0" if name == "mul" else "0.0"
            for this, other in (operands, operands[::-1]):
                if self.operations[this].name == "constant" and self.operations[this].constant == neutral:
                    return other
        return self.add(Operation(name, operands, kind, all(o.shared for o in used)))

    def kind_of(self, dtype: Any) -> str:
        dtype = np.dtype(dtype)
        if np.issubdtype(dtype, np.floating):
            return "f"
        if dtype == np.bool_:
            return "b"
        if dtype == np.int32 or (dtype == np.int64 and self.dtype == np.float64):  # as wide as its lanes
            return "i"
        raise UnsupportedError(f"it has numbers of type {dtype}")

    def array(self, shape: tuple[int, ...], number: Callable[[int], int]) -> Values:
        values = np.empty(math.prod(shape), object)
        values[:] = [number(i) for i in range(values.size)]
        return values.reshape(shape)

    def literal(self, value: Any) -> Values:
        value = np.asarray(value)
        kind, flat = self.kind_of(value.dtype), value.ravel()
        return self.array(value.shape, lambda i: self.constant(flat[i], kind))

    def map(self, function: Callable[..., int], *arrays: Values) -> Values:
        arrays = np.broadcast_arrays(*arrays)
        flat = [a.ravel() for a in arrays]
        return self.array(arrays[0].shape, lambda i: function(*(int(f[i]) for f in flat)))

    # --- Programs ---

    def run(self, jaxpr: Any, consts: Sequence[Any], args: Sequence[Values]) -> list[Values]:
        values: dict[Any, Values] = {}

        def read(v: Any) -> Values:
            return self.literal(np.asarray(v.val, v.aval.dtype)) if hasattr(v, "val") else values[v]

        for v, value in zip(jaxpr.constvars, consts, strict=True):
            values[v] = self.literal(np.asarray(value, v.aval.dtype))
        values |= zip(jaxpr.invars, args, strict=True)
        for eqn in jaxpr.eqns:
            outs = self.equation(eqn, [read(v) for v in eqn.invars])
            for v, out in zip(eqn.outvars, outs, strict=True):
                if out.shape != v.aval.shape:
                    raise UnsupportedError(f"it has the operation {eqn.primitive.name} in a form that is not known")
                values[v] = out
        return [read(v) for v in jaxpr.outvars]

    def equation(self, eqn: Any, args: list[Values]) -> list[Values]:
        name, params = eqn.primitive.name, eqn.params
        if not eqn.outvars or any(0 in v.aval.shape for v in (*eqn.invars, *eqn.outvars)):
            raise UnsupportedError(f"it has the operation {name} of nothing or without a result")
        if eqn.primitive is linear_pass_p:
            inner = jax.make_jaxpr(lambda *a: run_elsewhere(*a, **params))(*(v.aval for v in eqn.invars))
            return self.run(inner.jaxpr, inner.consts, args)
        if name == "scan":
            return self.scan(params, args)
        if name == "reduce":
            return self.reduce(params, args)
        if name in _CALLS:
            inner = params["jaxpr"] if "jaxpr" in params else params["call_jaxpr"]
            closed = hasattr(inner, "consts")
            return self.run(inner.jaxpr if closed else inner, inner.consts if closed else (), args)
        # Numbers of another precision are constants at most, which become what they meet.
        if name not in _KEEPS_CONSTANTS and any(
            np.issubdtype(v.aval.dtype, np.floating) and v.aval.dtype != self.dtype for v in eqn.outvars
        ):
            raise UnsupportedError(f"it computes with floating types other than {self.dtype}")
        if name in ("optimization_barrier", "copy", "copy_p", "stop_gradient"):
            return args
        if name == "unstack":
            moved = np.moveaxis(args[0], params["axis"], 0)
            return [np.asarray(moved[i], object) for i in range(len(moved))]
        if name in _SHAPES:
            return [_SHAPES[name](args, params, eqn.outvars[0].aval)]
        return [self.arithmetic(name, params, args, eqn.outvars[0].aval)]

    def scan(self, params: dict[str, Any], args: list[Values]) -> list[Values]:
        """A short loop, written out."""
        length, jaxpr = params["length"], params["jaxpr"]
        if not 0 < length <= _LONGEST_LOOP:
            raise UnsupportedError(f"it has a loop of {length} turns")
        first, last = params["num_consts"], params["num_consts"] + params["num_carry"]
        consts, carry, given = args[:first], args[first:last], args[last:]
        turns = []
        for i in reversed(range(length)) if params["reverse"] else range(length):
            of_turn = [np.asarray(g[i], object) for g in given]
            out = self.run(jaxpr.jaxpr, jaxpr.consts, [*consts, *carry, *of_turn])
            carry = out[: params["num_carry"]]
            turns.append(out[params["num_carry"] :])
        if params["reverse"]:
            turns.reverse()
        return [*carry, *(np.stack(same) for same in zip(*turns, strict=True))]

    def reduce(self, params: dict[str, Any], args: list[Values]) -> list[Values]:
        """Several arrays reduced together by a function of their numbers."""
        jaxpr, axes, half = params["jaxpr"], params["dimensions"], len(args) // 2
        rows = [_rows(a, axes) for a in args[:half]]
        totals = [np.full(a.shape[1:], initial[()], object) for a, initial in zip(rows, args[half:], strict=True)]
        for place in np.ndindex(totals[0].shape):
            for k in range(len(rows[0])):
                numbers = [np.asarray(a[place], object) for a in (*totals, *(np.asarray(r[k], object) for r in rows))]
                for total, number in zip(totals, self.run(jaxpr.jaxpr, jaxpr.consts, numbers), strict=True):
                    total[place] = number[()]
        return totals

    def arithmetic(self, name: str, params: dict[str, Any], args: list[Values], out: Any) -> Values:
        kind = self.kind_of(out.dtype)
        if name == "convert_element_type":
            return self.map(lambda a: self.converted(a, kind), *args)
        if name == "integer_pow":
            return self.map(lambda a: self.power(a, params["y"]), *args)
        if name == "square":
            return self.map(lambda a: self.apply("mul", a, a), *args)
        if name == "clamp":
            return self.map(lambda low, a, high: self.apply("min", self.apply("max", a, low), high), *args)
        if name == "select_n":
            if len(args) != 3:
                raise UnsupportedError(f"it has a select of {len(args) - 1} cases")
            return self.map(lambda which, no, yes: self.selected(which, no, yes), *args)
        if name in ("reduce_sum", "reduce_max", "reduce_min", "reduce_and", "reduce_or", "reduce_prod"):
            how = {"sum": "add", "prod": "mul"}.get(name[7:], name[7:])
            add = functools.partial(self.map, lambda a, b: self.apply(how, a, b))
            return np.asarray(functools.reduce(add, _rows(args[0], params["axes"])), object)
        if name == "dot_general":
            return self.product(params, *args)
        if name == "iota":
            return self.literal(np.indices(out.shape)[params["dimension"]].astype(out.dtype))
        name = {"add_any": "add"}.get(name, name)
        if name not in ARITHMETIC:
            raise UnsupportedError(f"it has the operation {name}")
        return self.map(lambda *a: self.apply(name, *a, kind=kind), *args)

    def converted(self, a: int, kind: str) -> int:
        return (
            a if self.operations[a].kind == kind else self.apply(f"{self.operations[a].kind}_to_{kind}", a, kind=kind)
        )

    def selected(self, which: int, no: int, yes: int) -> int:
        return no if no == yes else self.apply("select", which, yes, no, kind=self.operations[no].kind)

    def power(self, a: int, exponent: int) -> int:
        if self.operations[a].kind != "f":
            raise UnsupportedError("it has powers of whole numbers")
        if exponent < 0:
            return self.apply("div", self.constant(1.0, "f"), self.power(a, -exponent))
        if exponent == 0:
            return self.constant(1.0, "f")
        half = self.power(a, exponent // 2)
        squared = self.apply("mul", half, half) if exponent > 1 else self.constant(1.0, "f")
        return self.apply("mul", squared, a) if exponent % 2 else squared

    def product(self, params: dict[str, Any], a: Values, b: Values) -> Values:
        (contract_a, contract_b), (batch_a, batch_b) = params["dimension_numbers"]
        if batch_a or batch_b:
            raise UnsupportedError("it has a product of batches of arrays")
        terms = [
            self.map(lambda x, y: self.apply("mul", x, y), row.reshape(*row.shape, *[1] * column.ndim), column)
            for row, column in zip(_rows(a, contract_a), _rows(b, contract_b), strict=True)
        ]
        return functools.reduce(functools.partial(self.map, lambda x, y: self.apply("add", x, y)), terms)


def _rows(a: Values, axes: Sequence[int]) -> Values:
    """The arrays along the other axes, one after the other."""
    moved = np.moveaxis(a, axes, range(len(axes)))
    return moved.reshape(math.prod(moved.shape[: len(axes)]), *moved.shape[len(axes) :])


def _broadcast(args: list[Values], params: dict[str, Any], out: Any) -> Values:
    shape = [1] * len(out.shape)
    for size, axis in zip(args[0].shape, params["broadcast_dimensions"], strict=True):
        shape[axis] = size
    return np.broadcast_to(args[0].reshape(shape), out.shape)


def _slice(args: list[Values], params: dict[str, Any], out: Any) -> Values:
    del out
    steps = params["strides"] or (1,) * args[0].ndim
    bounds = zip(params["start_indices"], params["limit_indices"], steps, strict=True)
    return args[0][tuple(slice(*bound) for bound in bounds)]


def _pad(args: list[Values], params: dict[str, Any], out: Any) -> Values:
    values, filling = args
    if any(low < 0 or high < 0 for low, high, _ in params["padding_config"]):
        raise UnsupportedError("it has a pad that cuts")
    padded = np.full(out.shape, int(filling[()]), object)
    spots = zip(params["padding_config"], values.shape, strict=True)
    padded[tuple(slice(low, low + (size - 1) * (gap + 1) + 1, gap + 1) for (low, _, gap), size in spots)] = values
    return padded


_SHAPES: dict[str, Callable[[list[Values], dict[str, Any], Any], Values]] = {
    "broadcast_in_dim": _broadcast,
    "reshape": lambda args, params, out: args[0].reshape(out.shape),
    "squeeze": lambda args, params, out: args[0].reshape(out.shape),
    "expand_dims": lambda args, params, out: args[0].reshape(out.shape),
    "transpose": lambda args, params, out: args[0].transpose(params["permutation"]),
    "concatenate": lambda args, params, out: np.concatenate(args, axis=params["dimension"]),
    "rev": lambda args, params, out: np.flip(args[0], params["dimensions"]),
    "slice": _slice,
    "pad": _pad,
    "stack": lambda args, params, out: np.stack(args, axis=params["axis"]),
}
