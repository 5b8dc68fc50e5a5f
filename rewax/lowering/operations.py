"""Operations on single numbers, listed in order, each once.

An operation with the operands of an earlier one is that one, and one of constants is a constant. What derivatives and
constant tables are full of, sums and products with zero and one, is none at all.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rewax.lowering.indexing import Values

ARITHMETIC = frozenset({
    "add", "sub", "mul", "div", "neg", "max", "min", "abs", "sign", "sqrt", "rsqrt", "cbrt", "exp", "log",
    "log1p", "expm1", "sin", "cos", "tanh", "logistic", "pow", "atan2", "floor", "ceil", "is_finite", "lt",
    "le", "gt", "ge", "eq", "ne", "and", "or", "xor", "not",
})  # fmt: skip
"""Operations on numbers, by the names of JAX's primitives."""
OF_WHOLE = frozenset(["add", "sub", "max", "min", "lt", "le", "gt", "ge", "eq", "ne", "select", "i_to_f", "i_to_b"])
_OF_CONSTANTS: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative, "max": np.maximum,
    "min": np.minimum, "abs": np.abs, "sign": np.sign, "sqrt": np.sqrt, "floor": np.floor, "ceil": np.ceil,
    "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal,
    "and": np.logical_and, "or": np.logical_or, "xor": np.logical_xor, "not": np.logical_not, "rem": np.fmod,
    "select": lambda which, yes, no: yes if which else no,
    "i_to_f": lambda a: a, "b_to_f": lambda a: a, "b_to_i": lambda a: a, "i_to_b": bool,
}  # fmt: skip
"""What is computed here, once, where all operands are constants."""
_OF_WHOLE_CONSTANTS: dict[str, Callable[..., Any]] = {
    "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "not": np.invert,
    "div": lambda a, b: int(np.fix(a / b)),
}  # fmt: skip
"""Where whole numbers differ."""
_WHOLE = range(-(2**31), 2**31)
OF_TRUTH = frozenset(["and", "or", "xor", "not", "eq", "ne", "select", "b_to_f", "b_to_i"])


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


class Operations:
    """The list that a program becomes, and how it grows."""

    def __init__(self, dtype: np.dtype, most: int) -> None:
        self.dtype = dtype
        self.most = most
        self.listed: list[Operation] = []
        self.known: dict[Any, int] = {}
        self.constants: dict[int, Any] = {}

    def add(self, operation: Operation) -> int:
        if len(self.listed) >= self.most:
            raise UnsupportedError(f"it has more than {self.most} operations")
        self.listed.append(operation)
        return len(self.listed) - 1

    def input(self, place: int, offset: int, kind: str, varying: bool) -> int:
        return self.add(Operation("input", (), kind, not varying, (place, offset)))

    def constant(self, value: Any, kind: str) -> int:
        number = {"f": self.dtype.type, "i": int, "b": bool}[kind](value)
        key = ("constant", repr(number), kind)  # as text: -0.0 equals 0.0, and NaN nothing
        if key not in self.known:
            text = repr(float(value) if kind == "f" else number)
            self.known[key] = place = self.add(Operation("constant", (), kind, True, text))
            self.constants[place] = number
        return self.known[key]

    def apply(self, name: str, *operands: int, kind: str | None = None) -> int:
        key = (name, operands, kind)
        if key not in self.known:
            self.known[key] = self.applied(name, operands, kind)
        return self.known[key]

    def applied(self, name: str, operands: tuple[int, ...], kind: str | None) -> int:
        used = [self.listed[o] for o in operands]
        kinds = {o.kind for o in used}
        if "b" in kinds and name in ("max", "min"):
            name = {"max": "or", "min": "and"}[name]
        kind = used[0].kind if kind is None else kind
        constants = [self.constants.get(o) for o in operands]
        if name in _OF_CONSTANTS and all(c is not None for c in constants):
            return self.constant(self.of_constants(name, kinds, constants, kind), kind)
        for of, allowed, what in (("i", OF_WHOLE, "whole numbers"), ("b", OF_TRUTH, "truth values")):
            if of in kinds and name not in allowed:
                raise UnsupportedError(f"it has the operation {name} of {what}")
        if kind == "f" and name in ("mul", "div", "add", "sub"):
            simpler = self.simpler(name, operands, constants)
            if simpler is not None:
                return simpler
        return self.add(Operation(name, operands, kind, all(o.shared for o in used)))

    def of_constants(self, name: str, kinds: set[str], constants: list[Any], kind: str) -> Any:
        if kinds == {"i"} and name in ("div", "rem") and constants[1] == 0:
            raise UnsupportedError("it divides a whole number by zero")
        compute = _OF_WHOLE_CONSTANTS.get(name, _OF_CONSTANTS[name]) if kinds == {"i"} else _OF_CONSTANTS[name]
        with np.errstate(all="ignore"):
            value = compute(*constants)
        if kind == "i" and int(value) not in _WHOLE:
            raise UnsupportedError("it computes whole numbers of more than 32 bits")
        return value

    def simpler(self, name: str, operands: tuple[int, ...], constants: list[Any]) -> int | None:
        """What an operation with a zero or a one is without it."""
        (a, b), (number, other) = operands, constants
        if name in ("mul", "div"):
            if number == 0 or (other == 0 and name == "mul"):
                return self.constant(0.0, "f")
            return a if other == 1 else b if number == 1 and name == "mul" else None
        if other == 0:
            return a
        if number == 0:
            return b if name == "add" else self.apply("neg", b)
        return None

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
        return np.array([number(i) for i in range(math.prod(shape))], np.int64).reshape(shape)

    def literal(self, value: Any) -> Values:
        value = np.asarray(value)
        kind, flat = self.kind_of(value.dtype), value.ravel()
        return self.array(value.shape, lambda i: self.constant(flat[i], kind))

    def map(self, function: Callable[..., int], *arrays: Values) -> Values:
        arrays = np.broadcast_arrays(*arrays)
        numbers = [function(*each) for each in zip(*(a.ravel().tolist() for a in arrays), strict=True)]
        return np.array(numbers, np.int64).reshape(arrays[0].shape)

    def whole(self, values: Values) -> np.ndarray:
        """Whole numbers that are constants."""
        if not all(v in self.constants for v in values.ravel().tolist()):
            raise UnsupportedError("it has indices that depend on its arguments")
        return np.array([self.constants[v] for v in values.ravel().tolist()], np.int64).reshape(values.shape)

    def converted(self, a: int, kind: str) -> int:
        return a if self.listed[a].kind == kind else self.apply(f"{self.listed[a].kind}_to_{kind}", a, kind=kind)

    def selected(self, which: int, no: int, yes: int) -> int:
        if which in self.constants:
            return yes if self.constants[which] else no
        return no if no == yes else self.apply("select", which, yes, no, kind=self.listed[no].kind)

    def power(self, a: int, exponent: int) -> int:
        if self.listed[a].kind != "f":
            raise UnsupportedError("it has powers of whole numbers")
        if exponent < 0:
            return self.apply("div", self.constant(1.0, "f"), self.power(a, -exponent))
        if exponent == 0:
            return self.constant(1.0, "f")
        half = self.power(a, exponent // 2)
        squared = self.apply("mul", half, half) if exponent > 1 else self.constant(1.0, "f")
        return self.apply("mul", squared, a) if exponent % 2 else squared
