"""Traced programs as lists of operations on single numbers.

Loops and conditions have no place in such a list. Short loops are written out, and arrays, which are small, too.
Products with a zero that is written in the program are zero, whatever the other factor: constant tables of zeros and
ones cost nothing.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from rewax.lowering.indexing import ARRANGEMENTS, Values, gathered, rows, scattered
from rewax.lowering.linear_primitive import linear_call_p, run_scalar_form
from rewax.lowering.operations import ARITHMETIC, Operation, Operations, UnsupportedError

_LONGEST_LOOP = 64

_CALLS = frozenset({
    "jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "remat2", "custom_jvp_call", "custom_vjp_call",
    "custom_vmap_call",
})  # fmt: skip
_KEEPS_CONSTANTS = frozenset(
    ["select_n", "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "stack", "concatenate", "copy"]
)
_INDEXED = frozenset(["gather", "scatter", "scatter-add", "scatter-mul", "dynamic_slice", "dynamic_update_slice"])
_FILLING = {"f": float("nan"), "i": np.iinfo(np.int32).min, "b": True}
_REDUCTIONS = {"sum": "add", "prod": "mul", "max": "max", "min": "min", "and": "and", "or": "or"}


class OperationList(NamedTuple):
    """A program without loops and conditions."""

    operations: list[Operation]
    outputs: list[list[int]]
    """For each result the operations that give its numbers, in order."""
    dtype: np.dtype
    """The floating type."""


def from_jaxpr(program: ClosedJaxpr, varies: Sequence[bool], *, most: int = 5_000) -> OperationList:
    """A traced program of one element.

    Args:
      program: arithmetic on small arrays.
      varies: which of its arguments differ between the elements.
      most: so many operations it may have.

    Raises:
      UnsupportedError: it has something else.
    """
    dtype = _floating_type(program)
    builder, inputs = _Builder(dtype, most), []
    for k, (aval, varying) in enumerate(zip(program.in_avals, varies, strict=True)):
        kind = builder.kind_of(aval.dtype)
        inputs.append(builder.array(aval.shape, lambda i, k=k, kind=kind, v=varying: builder.input(k, i, kind, v)))
    if any(np.issubdtype(a.dtype, np.floating) and a.dtype != dtype for a in program.out_avals):
        raise UnsupportedError(f"its results are of floating types other than {dtype}")
    found = builder.run(program.jaxpr, program.consts, inputs)
    outputs = [np.ravel(output).tolist() for output in found]
    return OperationList(builder.listed, outputs, dtype)


def _floating_type(program: ClosedJaxpr) -> np.dtype:
    types = {a.dtype for a in program.in_avals if jax.numpy.issubdtype(a.dtype, np.floating)}
    if len(types) != 1 or not types <= {np.dtype(np.float32), np.dtype(np.float64)}:
        raise UnsupportedError(f"its floating types are {sorted(map(str, types))}")
    return types.pop()


class _Builder(Operations):
    """The list of a traced program's operations."""

    def run(self, jaxpr: Any, consts: Sequence[Any], args: Sequence[Values]) -> list[Values]:
        values: dict[Any, Values] = {}

        def read(v: Any) -> Values:
            return self.literal(np.asarray(v.val, v.aval.dtype)) if hasattr(v, "val") else values[v]

        for v, value in zip(jaxpr.constvars, consts, strict=True):
            values[v] = self.literal(np.asarray(value, v.aval.dtype))
        values |= zip(jaxpr.invars, args, strict=True)
        for eqn in jaxpr.eqns:
            unknown = UnsupportedError(f"it has the operation {eqn.primitive.name} in a form that is not known")
            try:
                outs = self.equation(eqn, [read(v) for v in eqn.invars])
            except (AttributeError, KeyError) as error:  # of a later version of JAX
                raise unknown from error
            for v, out in zip(eqn.outvars, outs, strict=True):
                if out.shape != v.aval.shape:
                    raise unknown
                values[v] = out
        return [read(v) for v in jaxpr.outvars]

    def equation(self, eqn: Any, args: list[Values]) -> list[Values]:
        name, params = eqn.primitive.name, eqn.params
        if not eqn.outvars:
            raise UnsupportedError(f"it has the operation {name} without a result")
        if eqn.primitive is linear_call_p:
            inner = jax.make_jaxpr(lambda *a: run_scalar_form(*a, **params))(*(v.aval for v in eqn.invars))
            return self.run(inner.jaxpr, inner.consts, args)
        if name == "scan":
            return self.scan(params, args)
        if name == "reduce":
            return self.reduce(params, args)
        if name == "custom_linear_solve":
            return self.linear_solve(params, args)
        if name in _CALLS:
            inner = next(params[key] for key in ("jaxpr", "call_jaxpr", "call") if key in params)
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
            return list(np.moveaxis(args[0], params["axis"], 0))
        if name == "split":
            return np.split(args[0], np.cumsum(params["sizes"])[:-1], axis=params["axis"])
        out = eqn.outvars[0].aval
        if name in ARRANGEMENTS:
            return [ARRANGEMENTS[name](args, params, out)]
        return [self.indexed(name, params, args, out) if name in _INDEXED else self.arithmetic(name, params, args, out)]

    def scan(self, params: dict[str, Any], args: list[Values]) -> list[Values]:
        """A short loop, written out."""
        length, jaxpr = params["length"], params["jaxpr"]
        if not 0 < length <= _LONGEST_LOOP:
            raise UnsupportedError(f"it has a loop of {length} turns")
        first, last = params["num_consts"], params["num_consts"] + params["num_carry"]
        consts, carry, given = args[:first], args[first:last], args[last:]
        turns = []
        for i in reversed(range(length)) if params["reverse"] else range(length):
            out = self.run(jaxpr.jaxpr, jaxpr.consts, [*consts, *carry, *(np.asarray(g[i]) for g in given)])
            carry = out[: params["num_carry"]]
            turns.append(out[params["num_carry"] :])
        if params["reverse"]:
            turns.reverse()
        return [*carry, *(np.stack(same) for same in zip(*turns, strict=True))]

    def reduce(self, params: dict[str, Any], args: list[Values]) -> list[Values]:
        """Several arrays reduced together by a function of their numbers."""
        jaxpr, axes, half = params["jaxpr"], params["dimensions"], len(args) // 2
        given = [rows(a, axes) for a in args[:half]]
        totals = [np.full(a.shape[1:], initial, np.int64) for a, initial in zip(given, args[half:], strict=True)]
        for place in np.ndindex(totals[0].shape):
            for k in range(len(given[0])):
                numbers = [np.asarray(a[place]) for a in (*totals, *(r[k] for r in given))]
                for total, number in zip(totals, self.run(jaxpr.jaxpr, jaxpr.consts, numbers), strict=True):
                    total[place] = number
        return totals

    def linear_solve(self, params: dict[str, Any], args: list[Values]) -> list[Values]:
        """``jax.lax.custom_linear_solve``: what its solver does."""
        lengths, solve = params["const_lengths"], params["jaxprs"].solve
        first = lengths.matvec + lengths.vecmat
        return self.run(solve.jaxpr, solve.consts, [*args[first : first + lengths.solve], *args[sum(lengths) :]])

    def indexed(self, name: str, params: dict[str, Any], args: list[Values], out: Any) -> Values:
        """Parts of arrays at places that are constants."""
        if name == "gather":
            filling = _FILLING[self.kind_of(out.dtype)] if params["fill_value"] is None else params["fill_value"]
            return gathered(args[0], self.whole(args[1]), params, out, self.constant(filling, self.kind_of(out.dtype)))
        if name.startswith("scatter"):
            how = {"scatter": None, "scatter-add": "add", "scatter-mul": "mul"}[name]
            merge = how and functools.partial(self.map, lambda a, b: self.apply(how, a, b))
            return scattered(args[0], self.whole(args[1]), args[2], params, merge)
        update = name == "dynamic_update_slice"
        sizes = args[1].shape if update else params["slice_sizes"]
        starts = [int(self.whole(a)) for a in args[2 if update else 1 :]]
        spots = zip(starts, sizes, args[0].shape, strict=True)
        where = tuple(slice(b, b + k) for b, k in ((max(min(start, n - k), 0), k) for start, k, n in spots))
        if not update:
            return args[0][where]
        result = args[0].copy()
        result[where] = args[1]
        return result

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
        if name.startswith("reduce_") and name[7:] in _REDUCTIONS:
            return self.folded(_REDUCTIONS[name[7:]], rows(args[0], params["axes"]), kind)
        if name in ("cumsum", "cumprod", "cummax", "cummin"):
            return self.accumulated({"sum": "add", "prod": "mul"}.get(name[3:], name[3:]), params, args[0])
        if name in ("argmax", "argmin"):
            return self.place_of_extreme("gt" if name == "argmax" else "lt", rows(args[0], params["axes"]))
        if name == "dot_general":
            return self.product(params, args[0], args[1], kind)
        if name == "iota":
            return self.literal(np.indices(out.shape)[params["dimension"]].astype(out.dtype))
        name = {"add_any": "add"}.get(name, name)
        if name not in ARITHMETIC and not (name == "rem" and kind == "i"):
            raise UnsupportedError(f"it has the operation {name}")
        return self.map(lambda *a: self.apply(name, *a, kind=kind), *args)

    def folded(self, how: str, terms: Values, kind: str) -> Values:
        """Sums, products and so on, from the first term to the last."""
        if not len(terms):
            if how not in ("add", "mul"):
                raise UnsupportedError("it has the greatest or least of nothing")
            return np.full(terms.shape[1:], self.constant({"add": 0, "mul": 1}[how], kind), np.int64)
        return functools.reduce(functools.partial(self.map, lambda a, b: self.apply(how, a, b)), terms)

    def accumulated(self, how: str, params: dict[str, Any], values: Values) -> Values:
        terms = np.moveaxis(values, params["axis"], 0)
        found = [self.folded(how, (terms[::-1] if params["reverse"] else terms)[:1], "f")]
        for term in (terms[::-1] if params["reverse"] else terms)[1:]:
            found.append(self.map(lambda a, b: self.apply(how, a, b), found[-1], term))
        return np.moveaxis(np.stack(found[::-1] if params["reverse"] else found), 0, params["axis"])

    def place_of_extreme(self, better: str, terms: Values) -> Values:
        """The first of the greatest or least terms; NaN is greater and less than anything."""
        best, place = terms[0], np.full(terms.shape[1:], self.constant(0, "i"), np.int64)
        for k, term in enumerate(terms[1:], start=1):
            which = self.map(lambda a, b: self.apply(better, a, b, kind="b"), term, best)
            if term.size and self.listed[int(term.flat[0])].kind == "f":
                nan, number = (
                    self.map(lambda a, how=how: self.apply(how, a, a, kind="b"), values)
                    for how, values in (("ne", term), ("eq", best))
                )
                which = self.map(lambda a, b, c: self.apply("or", a, self.apply("and", b, c)), which, nan, number)
            best = self.map(self.selected, which, best, term)
            place = self.map(lambda w, a, k=k: self.selected(w, a, self.constant(k, "i")), which, place)
        return place

    def product(self, params: dict[str, Any], a: Values, b: Values, kind: str) -> Values:
        (contract_a, contract_b), (batch_a, batch_b) = params["dimension_numbers"]
        a, b = (self.map(lambda x: self.converted(x, kind), values) for values in (a, b))
        batch = [a.shape[axis] for axis in batch_a]
        of_a, of_b = _contracted(a, batch_a, contract_a), _contracted(b, batch_b, contract_b)
        terms = self.map(lambda x, y: self.apply("mul", x, y), of_a[..., :, None], of_b[..., None, :])
        found = self.folded("add", np.moveaxis(terms, 1, 0), kind)
        return found.reshape(*batch, *_others(a, batch_a, contract_a), *_others(b, batch_b, contract_b))


def _contracted(a: Values, batch: Sequence[int], contract: Sequence[int]) -> Values:
    """Batch, contracted and other axes, as one each."""
    moved = np.moveaxis(a, (*batch, *contract), range(len(batch) + len(contract)))
    sizes = [math.prod(a.shape[axis] for axis in axes) for axes in (batch, contract)]
    return moved.reshape(*sizes, math.prod(_others(a, batch, contract)))


def _others(a: Values, batch: Sequence[int], contract: Sequence[int]) -> list[int]:
    return [size for axis, size in enumerate(a.shape) if axis not in (*batch, *contract)]
