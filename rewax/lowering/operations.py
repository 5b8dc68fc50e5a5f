"""Lists of scalar operations, with common subexpressions merged and constants folded.

As in XLA, ``1 x``, ``x / 1`` and ``x + 0`` are ``x``, and a product with a boolean is a selection. A product with zero
is computed, because it is NaN if the other factor is infinite or NaN. Structural zeros (``structural_zeros``) are
omitted from products and sums.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rewax.lowering.indexing import Values

ARITHMETIC = frozenset({
    "add", "sub", "mul", "div", "rem", "neg", "max", "min", "abs", "sign", "sqrt", "rsqrt", "cbrt", "exp", "exp2",
    "log", "log1p", "expm1", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh",
    "atanh", "erf", "erfc", "logistic", "pow", "atan2", "floor", "ceil", "round_even", "round_away", "is_finite", "lt",
    "le", "gt", "ge", "eq", "ne", "and", "or", "xor", "not",
})  # fmt: skip
"""Elementwise operations, by the names of JAX's primitives."""
ON_INTEGERS = frozenset([
    "add", "sub", "mul", "neg", "div", "rem", "max", "min", "sign", "lt", "le", "gt", "ge", "eq", "ne", "and", "or",
    "xor", "not", "select", "wrap",
])  # fmt: skip
"""Operations that integers support."""
ON_BOOLEANS = frozenset(["and", "or", "xor", "not", "eq", "ne", "select"])
"""Operations that booleans support, and unsigned integers that are no constants (JAX's scatters have some)."""
_WRAPS = frozenset(["add", "sub", "mul", "neg", "div"])
"""Operations on integers that can overflow."""
_COMPARISONS = frozenset(["lt", "le", "gt", "ge", "eq", "ne"])
_FOLDED: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative, "max": np.maximum,
    "min": np.minimum, "abs": np.abs, "sign": np.sign, "sqrt": np.sqrt, "floor": np.floor, "ceil": np.ceil,
    "round_even": np.rint, "rem": np.fmod, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal, "is_finite": np.isfinite,
    "select": lambda which, yes, no: yes if which else no,
}  # fmt: skip
"""Operations that are folded if all operands are constants."""
_INTEGER_FUNCTIONS: dict[str, Callable[[Any, Any], int]] = {
    "add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b, "and": lambda a, b: a & b,
    "or": lambda a, b: a | b, "xor": lambda a, b: a ^ b,
    # As in XLA: towards zero; division by zero gives -1 and the dividend.
    "div": lambda a, b: -1 if b == 0 else abs(a) // abs(b) * (1 if (a < 0) == (b < 0) else -1),
    "rem": lambda a, b: a if b == 0 else abs(a) % abs(b) * (-1 if a < 0 else 1),
}  # fmt: skip
_BOOLEAN_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "and": np.logical_and, "or": np.logical_or, "xor": np.logical_xor, "not": np.logical_not,
}  # fmt: skip
KINDS = {
    "f": "floating-point numbers", "i": "32-bit integers", "l": "64-bit integers", "u": "unsigned integers",
    "b": "booleans",
}  # fmt: skip
_BITS = {"i": 32, "l": 64, "u": 32}


class UnsupportedError(Exception):
    """A program cannot be lowered. The message completes a sentence about the program and names the reason."""


class Operation(NamedTuple):
    """A scalar operation on the results of earlier operations."""

    name: str
    """One of ``ARITHMETIC``, ``select``, ``constant``, ``input``, ``wrap`` (an integer to 32 bits), or a conversion,
    ``b_to_f``; ``carry`` is a value of a ``Loop``, ``result`` the same after it."""
    operands: tuple[int, ...]
    """Indices of earlier operations."""
    kind: str
    """One of ``KINDS``; ``f`` has the program's one precision."""
    shared: bool
    """Whether all elements of a batch element share the value."""
    constant: Any = None
    """The value of a ``constant``, as text; the index of the argument and the offset in it of an ``input``; the indices
    of the loop and of the value in it of a ``carry`` and a ``result``."""
    place: tuple[int, ...] = ()
    """Where it is computed, that of its last operand: () before all loops, see ``Loop``."""


class Loop(NamedTuple):
    """Operations that are repeated while a condition holds: those whose place begins with the loop's.

    Places are ordered. A program is computed in the order of its operations' places, and at one place in the order of
    the list. The first loop at place p is at (*p, 1), what follows from its results at (*p, 2), the second loop at
    (*p, 3). An operation in a loop that does not depend on the loop's values is computed before the loop.
    """

    place: tuple[int, ...]
    condition: int
    """A boolean of the values in this turn: whether the turn counts."""
    initial: tuple[int, ...]
    """The values before the first turn."""
    carried: tuple[int, ...]
    """The values in this turn."""
    following: tuple[int, ...]
    """The values in the next turn; those of this turn if the condition does not hold."""


class Operations:
    """Builds a list of operations."""

    def __init__(self, dtype: np.dtype, most: int) -> None:
        self.dtype = dtype
        self.most = most
        self.listed: list[Operation] = []
        self.known: dict[Any, int] = {}
        self.constants: dict[int, Any] = {}
        self.absent: int | None = None
        """Index of the structural zero, if there is one."""
        self.loops: list[Loop] = []
        self.inside: tuple[int, ...] = ()
        """Place of the loop whose operations are being listed."""
        self.passed = 0
        """Twice the number of loops that have ended inside of it."""

    def add(self, operation: Operation) -> int:
        if len(self.listed) >= self.most:
            raise UnsupportedError(f"it has more than {self.most} operations")
        if self.loops and operation.operands:
            operation = operation._replace(place=max(self.listed[o].place for o in operation.operands))
        self.listed.append(operation)
        return len(self.listed) - 1

    def input(self, argument: int, offset: int, kind: str, varying: bool) -> int:
        return self.add(Operation("input", (), kind, not varying, (argument, offset)))

    def constant(self, value: Any, kind: str) -> int:
        number = {"f": self.dtype.type, "b": bool}.get(kind, int)(value)
        key = ("constant", repr(number), kind)  # as text: -0.0 equals 0.0, and NaN nothing
        if key not in self.known:
            text = repr(float(value) if kind == "f" else number)
            self.known[key] = index = self.add(Operation("constant", (), kind, True, text))
            self.constants[index] = number
        return self.known[key]

    def loop(
        self,
        initial: list[Values],
        condition: Callable[[list[Values]], Values],
        turn: Callable[[list[Values]], list[Values]],
    ) -> list[Values]:
        """The values after turns of a loop, which end when the condition of the values does not hold."""
        begin = [i for values in initial for i in values.ravel().tolist()]
        number, inside, passed = len(self.loops), self.inside, self.passed
        self.inside, self.passed = place, _ = (*inside, passed + 1), 0
        self.loops.append(Loop(place, 0, (), (), ()))  # from here on, operations have places
        carried = self.alike(initial, lambda k: self.carry("carry", begin[k], (number, k), place))
        holds = int(condition(carried).ravel()[0])
        if self.listed[holds].place < place:
            raise UnsupportedError("it has the operation while with a condition that does not change")
        now = [i for values in carried for i in values.ravel().tolist()]
        after = [i for values in turn(carried) for i in values.ravel().tolist()]
        following = tuple(self.selected(holds, i, j) for i, j in zip(now, after, strict=True))
        self.loops[number] = Loop(place, holds, tuple(begin), tuple(now), following)
        self.inside, self.passed = inside, passed + 2
        return self.alike(initial, lambda k: self.carry("result", begin[k], (number, k), (*inside, passed + 2)))

    def carry(self, name: str, like: int, which: tuple[int, int], place: tuple[int, ...]) -> int:
        return self.add(Operation(name, (), self.listed[like].kind, False, which, place))

    def alike(self, given: list[Values], number: Callable[[int], int]) -> list[Values]:
        """Arrays of the shapes of others, with ``number(k)`` as the k-th of all their entries."""
        ends = np.cumsum([0, *(values.size for values in given)]).tolist()
        return [
            self.array(values.shape, lambda k, first=first: number(first + k))
            for values, first in zip(given, ends[:-1], strict=True)
        ]

    def structural(self, values: Values) -> Values:
        """The same values; constant zeros become structural zeros."""

        def mark(i: int) -> int:
            if self.listed[i].kind != "f" or self.constants.get(i) != 0:
                return i
            if self.absent is None:
                self.absent = self.add(Operation("constant", (), "f", True, "0.0"))
            return self.absent

        return self.map(mark, values)

    def apply(self, name: str, *operands: int, kind: str | None = None) -> int:
        """Index of the operation, or of an earlier operation or operand with the same value.

        Args:
          name: name of the operation.
          operands: indices of its operands.
          kind: kind of its result; None: that of its first operand.
        """
        key = (name, operands, kind)
        if key not in self.known:
            self.known[key] = self.applied(name, operands, kind)
        return self.known[key]

    def applied(self, name: str, operands: tuple[int, ...], kind: str | None) -> int:
        if self.absent is not None and self.absent in operands:
            simpler = self.without_absent(name, operands)
            if simpler is not None:
                return simpler
            operands = tuple(self.constant(0.0, "f") if o == self.absent else o for o in operands)
        used = [self.listed[o] for o in operands]
        compared = used[1:] if name == "select" else used
        of = compared[0].kind
        if any(o.kind != of for o in compared):
            raise UnsupportedError(f"it has the operation {name} of {' and '.join(KINDS[o.kind] for o in compared)}")
        if of == "b" and name in ("max", "min"):
            name = {"max": "or", "min": "and"}[name]
        kind = kind or (of if name not in _COMPARISONS else "b")
        constants = [self.constants.get(o) for o in operands]
        if all(c is not None for c in constants):
            value = self.folded_value(name, of, constants, kind)
            if value is not None:
                return self.constant(value, kind)
        if of == "u" and name == "not":  # an unsigned integer has 32 bits even in lanes of 64 bits
            return self.apply("xor", *operands, self.constant(2**32 - 1, "u"), kind="u")
        self.check(name, of)
        if of == "f" and name in ("mul", "div", "add", "sub"):
            simpler = self.simpler(name, operands, constants)
            if simpler is not None:
                return simpler
        result = self.add(Operation(name, operands, kind, all(o.shared for o in used)))
        # In lanes of 64 bits an overflowed integer of 32 bits must be wrapped.
        return self.apply("wrap", result) if kind == "i" and name in _WRAPS and self.dtype.itemsize == 8 else result

    def check(self, name: str, kind: str) -> None:
        """Raises UnsupportedError if a kind of numbers does not support an operation."""
        allowed = {"b": ON_BOOLEANS, "u": ON_BOOLEANS, "i": ON_INTEGERS, "l": ON_INTEGERS}.get(kind)
        if "_to_" not in name and (name not in allowed if allowed else name == "wrap"):
            raise UnsupportedError(f"it has the operation {name} of {KINDS[kind]}")
        if kind == "f" and name in ("and", "or", "xor", "not"):
            raise UnsupportedError(f"it has the operation {name} of {KINDS[kind]}")

    def folded_value(self, name: str, of: str, constants: list[Any], kind: str) -> Any:
        """The value of an operation on constants; None if it is not folded."""
        if "_to_" in name:
            return self.converted_value(constants[0], of, kind)
        if name == "wrap":
            return wrapped(constants[0], "i")
        if of in _BITS and name in ("neg", "not"):
            return wrapped(-constants[0] if name == "neg" else ~constants[0], of)
        if of in _BITS and name in _INTEGER_FUNCTIONS:
            return wrapped(_INTEGER_FUNCTIONS[name](*constants), of)
        table = _BOOLEAN_FUNCTIONS if of == "b" and name in _BOOLEAN_FUNCTIONS else _FOLDED
        with np.errstate(all="ignore"):
            return table[name](*constants) if name in table else None

    def converted_value(self, value: Any, of: str, kind: str) -> Any:
        if kind in _BITS and of == "f":
            least, most = (0, 2**32 - 1) if kind == "u" else (-(2 ** (_BITS[kind] - 1)), 2 ** (_BITS[kind] - 1) - 1)
            # In single precision the largest integer is rounded up: compare Python's numbers.
            return 0 if np.isnan(value) else least if value <= least else most if float(value) > most else int(value)
        if kind in _BITS:
            return wrapped(int(value), kind)
        return bool(value) if kind == "b" else value

    def without_absent(self, name: str, operands: tuple[int, ...]) -> int | None:
        """The result of an operation with a structural zero if it needs no computation, else None."""
        first, *others = operands
        if name in ("mul", "neg") or (name == "div" and first == self.absent):
            return self.absent
        if name in ("add", "sub") and others[0] == self.absent:
            return first
        if name in ("add", "sub"):
            return others[0] if name == "add" else self.apply("neg", others[0])
        return None

    def simpler(self, name: str, operands: tuple[int, ...], constants: list[Any]) -> int | None:
        """XLA's simplification of an operation with a zero, a one or a boolean: an operand, a selection, or None."""
        (a, b), (number, other) = operands, constants
        if name == "mul":
            for factor, boolean in ((a, b), (b, a)):
                if self.listed[boolean].name == "b_to_f":
                    return self.selected(self.listed[boolean].operands[0], self.constant(0.0, "f"), factor)
        if name in ("mul", "div"):
            return a if other == 1 else b if number == 1 and name == "mul" else None
        return a if other == 0 else b if number == 0 and name == "add" else None

    def kind_of(self, dtype: Any) -> str:
        """The kind of a type.

        Raises:
          UnsupportedError: lanes of the program's precision cannot hold them.
        """
        dtype = plain_type(dtype)
        if np.issubdtype(dtype, np.floating):
            return "f"
        if dtype == np.bool_:
            return "b"
        if dtype == np.int32:
            return "i"
        if dtype == np.uint32:
            return "u"
        if dtype == np.int64 and self.dtype == np.float64:
            return "l"
        raise UnsupportedError(f"it has numbers of type {dtype} beside {self.dtype}")

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

    def constant_integers(self, values: Values) -> np.ndarray:
        """The values of integers that are constants."""
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
        kind = self.listed[a].kind
        if exponent < 0:
            if kind != "f":
                raise UnsupportedError("it has negative powers of integers")
            return self.apply("div", self.constant(1.0, "f"), self.power(a, -exponent))
        if exponent == 0:
            return self.constant(1, kind)
        half = self.power(a, exponent // 2)
        squared = self.apply("mul", half, half) if exponent > 1 else self.constant(1, kind)
        if kind != "f" and exponent == 1:
            return a
        return self.apply("mul", squared, a) if exponent % 2 else squared


def plain_type(dtype: Any) -> np.dtype:
    """A type of NumPy.

    Raises:
      UnsupportedError: NumPy has no such type.
    """
    try:
        return np.dtype(dtype)
    except TypeError:  # random keys
        raise UnsupportedError(f"it has numbers of type {dtype}") from None


def wrapped(value: int, kind: str) -> int:
    """Wraps an integer to the bits of a kind."""
    bits = _BITS[kind]
    least = 0 if kind == "u" else -(2 ** (bits - 1))
    return (int(value) - least) % 2**bits + least
