"""Table of JAX's primitives that can be lowered: their known parameters and their scalar operations.

A primitive or parameter outside the table is refused, because a later version of JAX may give it a new meaning.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rewax.lowering.indexing import PARTS, Values, gathered, rows, scattered
from rewax.lowering.operations import ARITHMETIC, KINDS, Operations, UnsupportedError


class Equation(NamedTuple):
    """One equation of a traced program."""

    name: str
    params: dict[str, Any]
    out: Any
    """Shape and type of its first result."""


class Primitive(NamedTuple):
    """How a primitive is lowered."""

    parameters: frozenset[str]
    """Parameters that ``lower`` honours, or that do not affect the result."""
    lower: Callable[[Any, Equation, list[Values]], Values]
    """``(builder, equation, arguments) -> result``."""


_NO_EFFECT = frozenset({"sharding", "out_sharding", "precision", "indices_are_sorted", "unique_indices", "weak_type"})
"""Parameters of many primitives that do not affect the result."""


def elementwise(builder: Operations, eqn: Equation, args: list[Values], name: str | None = None) -> Values:
    """Applies an operation elementwise."""
    refuse_unless(eqn, accuracy=(None,), out_dtype=(None, eqn.out.dtype))
    kind = builder.kind_of(eqn.out.dtype)
    return builder.map(lambda *a: builder.apply(name or eqn.name, *a, kind=kind), *args)


def refuse_unless(eqn: Equation, **allowed: tuple[Any, ...]) -> None:
    """Raises UnsupportedError if a parameter has a value that is not allowed."""
    for name, values in allowed.items():
        if eqn.params.get(name) not in values:
            raise UnsupportedError(f"it has the operation {eqn.name} with {name}={eqn.params[name]}")


def _abs(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    if b.kind_of(eqn.out.dtype) == "f":
        return elementwise(b, eqn, args)
    return b.map(lambda a: b.apply("max", a, b.apply("neg", a)), *args)


def _convert(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    kind = b.kind_of(eqn.out.dtype)
    return b.map(lambda a: b.converted(a, kind), *args)


def _pow(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    """Constant integers as exponents, as in ``x ** jnp.arange(3)``, become products."""

    def one(base: int, exponent: int) -> int:
        if b.kind_of(eqn.out.dtype) == b.listed[exponent].kind or exponent not in b.constants:
            return b.apply("pow", base, exponent)
        return b.power(base, int(b.constants[exponent]))

    return b.map(one, *args)


def _integer_pow(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    return b.map(lambda a: b.power(a, eqn.params["y"]), *args)


def _square(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    return b.map(lambda a: b.apply("mul", a, a), *args)


def _one_minus_square(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    one = b.constant(1.0, "f")
    return b.map(lambda a: b.apply("mul", b.apply("add", one, a), b.apply("sub", one, a)), *args)


def _clamp(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    return b.map(lambda low, a, high: b.apply("min", b.apply("max", a, low), high), *args)


def _round(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    method = {0: "round_away", 1: "round_even"}[int(eqn.params["rounding_method"])]
    return elementwise(b, eqn, args, method)


def _reduce_precision(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    """Accepts only the program's own precision."""
    bits = np.finfo(b.dtype)
    refuse_unless(eqn, exponent_bits=(bits.nexp,), mantissa_bits=(bits.nmant,))
    return args[0]


def select(b: Operations, which: Values, cases: Sequence[Values]) -> Values:
    """Selects a case by a boolean, or by an integer that is clipped to the number of cases."""
    if len(cases) == 1:
        return b.map(lambda _, case: case, which, cases[0])
    if which.size and b.listed[int(which.flat[0])].kind == "b":
        return b.map(b.selected, which, *cases)
    chosen = cases[0]
    for k, case in enumerate(cases[1:], start=1):
        chosen = b.map(lambda w, no, yes, k=k: b.selected(_at_least(b, w, k), no, yes), which, chosen, case)
    return chosen


def _at_least(b: Operations, a: int, number: int) -> int:
    return b.apply("ge", a, b.constant(number, b.listed[a].kind))


def _select_n(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    return select(b, args[0], args[1:])


def fold(b: Operations, how: str, terms: Values, kind: str) -> Values:
    """Reduces along the first axis, from the first term to the last."""
    if not len(terms):
        neutral = {"add": 0, "mul": 1, "or": False, "and": True}
        if how not in neutral or (how in ("or", "and") and kind != "b"):
            raise UnsupportedError(f"it has the {how} of nothing")
        return np.full(terms.shape[1:], b.constant(neutral[how], kind), np.int64)
    return functools.reduce(functools.partial(b.map, lambda x, y: b.apply(how, x, y)), terms)


def _reduction(how: str) -> Callable[[Operations, Equation, list[Values]], Values]:
    def lower(b: Operations, eqn: Equation, args: list[Values]) -> Values:
        return fold(b, how, rows(args[0], eqn.params["axes"]), b.kind_of(eqn.out.dtype))

    return lower


def _cumulative(how: str) -> Callable[[Operations, Equation, list[Values]], Values]:
    def lower(b: Operations, eqn: Equation, args: list[Values]) -> Values:
        axis, backwards = eqn.params["axis"], eqn.params["reverse"]
        if not args[0].size:
            return args[0]
        terms = np.moveaxis(args[0], axis, 0)
        found: list[Values] = []
        for term in terms[::-1] if backwards else terms:
            found.append(b.map(lambda x, y: b.apply(how, x, y), found[-1], term) if found else term)
        return np.moveaxis(np.stack(found[::-1] if backwards else found), 0, axis)

    return lower


def _index_of_extreme(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    """Index of the first greatest or least term; NaN counts as the extreme."""
    better, kind = "gt" if eqn.name == "argmax" else "lt", b.kind_of(eqn.params["index_dtype"])
    terms = rows(args[0], eqn.params["axes"])
    best, index = terms[0], np.full(terms.shape[1:], b.constant(0, kind), np.int64)
    for k, term in enumerate(terms[1:], start=1):
        which = b.map(lambda x, y: b.apply(better, x, y), term, best)
        if term.size and b.listed[int(term.flat[0])].kind == "f":
            nan = b.map(lambda x: b.apply("ne", x, x), term)
            number = b.map(lambda x: b.apply("eq", x, x), best)
            which = b.map(lambda x, y, z: b.apply("or", x, b.apply("and", y, z)), which, nan, number)
        best = b.map(b.selected, which, best, term)
        index = b.map(lambda w, x, k=k: b.selected(w, x, b.constant(k, kind)), which, index)
    return index


def _dot_general(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    (contract_x, contract_y), (batch_x, batch_y) = eqn.params["dimension_numbers"]
    kind = b.kind_of(eqn.out.dtype)
    x, y = (b.map(lambda a: b.converted(a, kind), values) for values in args)
    batch = [x.shape[axis] for axis in batch_x]
    of_x, of_y = _contracted(x, batch_x, contract_x), _contracted(y, batch_y, contract_y)
    terms = b.map(lambda p, q: b.apply("mul", p, q), of_x[..., :, None], of_y[..., None, :])
    found = fold(b, "add", np.moveaxis(terms, 1, 0), kind)
    return found.reshape((*batch, *_others(x, batch_x, contract_x), *_others(y, batch_y, contract_y)))


def _contracted(a: Values, batch: Sequence[int], contract: Sequence[int]) -> Values:
    """The array with its batch, contracted and other axes flattened into one axis each."""
    moved = np.moveaxis(a, (*batch, *contract), range(len(batch) + len(contract)))
    sizes = [math.prod(a.shape[axis] for axis in axes) for axes in (batch, contract)]
    return moved.reshape((*sizes, math.prod(_others(a, batch, contract))))


def _others(a: Values, batch: Sequence[int], contract: Sequence[int]) -> list[int]:
    return [size for axis, size in enumerate(a.shape) if axis not in (*batch, *contract)]


def _iota(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    if args:
        raise UnsupportedError("it has the operation iota of a shape that depends on its arguments")
    return b.literal(np.indices(eqn.out.shape)[eqn.params["dimension"]].astype(eqn.out.dtype))


def _gather(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    kind, given = b.kind_of(eqn.out.dtype), eqn.params["fill_value"]
    nothing = {"f": float("nan"), "i": -(2**31), "l": -(2**63), "u": 2**32 - 1, "b": True}[kind]
    filling = b.constant(nothing if given is None else given, kind)
    return gathered(args[0], b.constant_integers(args[1]), eqn.params, eqn.out, filling)


def _scatter(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    jaxpr, consts = eqn.params["update_jaxpr"], eqn.params["update_consts"]

    def merge(old: Values, update: Values) -> Values:
        pairs = zip(old.ravel(), update.ravel(), strict=True)
        new = [b.run(jaxpr, consts, [np.asarray(o), np.asarray(u)])[0] for o, u in pairs]  # type: ignore[attr-defined]
        return np.array(new, np.int64).reshape(old.shape)

    if jaxpr is None and eqn.name != "scatter":
        raise UnsupportedError(f"it has the operation {eqn.name} without a function")
    return scattered(args[0], b.constant_integers(args[1]), args[2], eqn.params, merge if jaxpr is not None else None)


def _dynamic_slice(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    return args[0][_window(b, args[0], args[1:], eqn.params["slice_sizes"])]


def _dynamic_update_slice(b: Operations, eqn: Equation, args: list[Values]) -> Values:
    result = args[0].copy()
    result[_window(b, args[0], args[2:], args[1].shape)] = args[1]
    return result


def _window(b: Operations, a: Values, starts: Sequence[Values], sizes: Sequence[int]) -> tuple[slice, ...]:
    """A window at constant indices, clamped to the array as in JAX."""
    integers = [int(b.constant_integers(start)) for start in starts]
    firsts = [max(min(start, n - k), 0) for start, k, n in zip(integers, sizes, a.shape, strict=True)]
    return tuple(slice(first, first + k) for first, k in zip(firsts, sizes, strict=True))


def _part(name: str) -> Callable[[Operations, Equation, list[Values]], Values]:
    return lambda b, eqn, args: PARTS[name](args, eqn.params, eqn.out)


def _named(parameters: str, lower: Callable[[Any, Equation, list[Values]], Values]) -> Primitive:
    return Primitive(_NO_EFFECT | set(parameters.split()), lower)


_INDEXING = "dimension_numbers mode"
PRIMITIVES: dict[str, Primitive] = {
    **{name: _named("accuracy out_dtype", elementwise) for name in ARITHMETIC - {"round_even", "round_away", "abs"}},
    "add_any": _named("", functools.partial(elementwise, name="add")),
    "abs": _named("", _abs),
    "convert_element_type": _named("new_dtype", _convert),
    "pow": _named("", _pow),
    "integer_pow": _named("y", _integer_pow),
    "square": _named("", _square),
    "one_minus_square": _named("", _one_minus_square),
    "clamp": _named("", _clamp),
    "round": _named("rounding_method", _round),
    "reduce_precision": _named("exponent_bits mantissa_bits", _reduce_precision),
    "select_n": _named("", _select_n),
    **{
        f"reduce_{name}": _named("axes", _reduction(how))
        for name, how in {
            "sum": "add", "prod": "mul", "max": "max", "min": "min", "and": "and", "or": "or", "xor": "xor",
        }.items()
    },
    **{
        f"cum{name}": _named("axis reverse", _cumulative(how))
        for name, how in {"sum": "add", "prod": "mul", "max": "max", "min": "min"}.items()
    },
    "argmax": _named("axes index_dtype", _index_of_extreme),
    "argmin": _named("axes index_dtype", _index_of_extreme),
    "dot_general": _named("dimension_numbers preferred_element_type", _dot_general),
    "iota": _named("dtype shape dimension", _iota),
    "gather": _named(f"{_INDEXING} slice_sizes fill_value", _gather),
    **{
        f"scatter{how}": _named(f"{_INDEXING} update_jaxpr update_consts", _scatter)
        for how in ("", "-add", "-sub", "-mul", "-min", "-max")
    },
    "dynamic_slice": _named("slice_sizes", _dynamic_slice),
    "dynamic_update_slice": _named("", _dynamic_update_slice),
    "broadcast_in_dim": _named("shape broadcast_dimensions", _part("broadcast_in_dim")),
    "reshape": _named("new_sizes dimensions", _part("reshape")),
    "squeeze": _named("dimensions", _part("squeeze")),
    "expand_dims": _named("dimensions", _part("expand_dims")),
    "transpose": _named("permutation", _part("transpose")),
    "concatenate": _named("dimension", _part("concatenate")),
    "rev": _named("dimensions", _part("rev")),
    "tile": _named("reps", _part("tile")),
    "slice": _named("start_indices limit_indices strides", _part("slice")),
    "pad": _named("padding_config", _part("pad")),
    "stack": _named("axis", _part("stack")),
}  # fmt: skip
"""The lowered primitives by name."""

__all__ = ["KINDS", "PRIMITIVES", "Equation", "Primitive", "fold", "refuse_unless", "select"]
