"""Checks of numbers that a user gives.

A ``Number`` says once what a field may hold. ``check_numbers`` raises where a value is known and illegal, when a scene
is built. ``any_illegal`` answers inside compiled programs, where values are traced, and costs a few comparisons.
"""

import dataclasses
import enum
import functools
import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax.types import Array


class Legal(NamedTuple):
    """The finite numbers between two limits."""

    low: float = -math.inf
    high: float = math.inf
    closed: bool = False
    """Whether ``low`` itself is legal."""

    def holds(self, value: Any) -> Any:
        """Whether each of the values is legal; false for NaN."""
        above = value >= self.low if self.closed else value > self.low
        return above & (value < self.high)

    def __str__(self) -> str:
        if self == POSITIVE:
            return "positive"
        if self == NOT_NEGATIVE:
            return "0 or more"
        return "finite" if self == FINITE else f"above {self.low:.4g} and below {self.high:.4g}"


_SMALL = 1024
"""Arrays of at most so many numbers are compared together."""
POSITIVE = Legal(low=0.0)
NOT_NEGATIVE = Legal(low=0.0, closed=True)
FINITE = Legal()
GRAVITY = "give an acceleration in m/s^2, (0, -9.81, 0) on Earth"
"""What messages advise about gravity."""


class Number(NamedTuple):
    """A field that holds a number or an array of them."""

    name: str
    value: Any
    legal: Legal
    remedy: str
    shape: tuple[int, ...] | None = None
    """The shape that the value must have; None: any."""


def numbers_of(tree: Any, prefix: str = "") -> list[Number]:
    """The fields of an object that ``struct.number`` made, and what they may be.

    Fields that are None by default stay out where they are.

    Args:
      tree: an object of a ``struct.dataclass``.
      prefix: what messages write before the names of its fields.
    """
    found = []
    for field in dataclasses.fields(tree):
        if (rule := field.metadata.get("number")) is None:
            continue
        value = getattr(tree, field.name)
        if value is not None or field.default is not None:
            found.append(Number(prefix + field.name, value, *rule))
    return found


def check_numbers(numbers: Iterable[Number]) -> None:
    """Raises ValueError for the first number that is known and illegal. The message names field, value and remedy.

    The values of traced numbers are not known: they pass. Their shapes are.
    """
    for number in numbers:
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(number.value)):
            array = jnp.asarray(number.value)
        else:
            array = _as_array(number)
            holds = number.legal.holds(array)
            if not np.all(holds):
                raise ValueError(_sentence(number, array, ~holds))
        if number.shape is not None and array.shape != number.shape:
            raise ValueError(f"{number.name} has shape {array.shape}: give an array of shape {number.shape}")


def any_illegal(numbers: Iterable[Number]) -> Array:
    """Whether one of the numbers is illegal, shape (), bool. Numbers that are None do not count. Gradient: none.

    Known values are compared while tracing and are no part of the program.
    """
    illegal: list[Any] = [jnp.bool_(False)]
    small: dict[tuple[Legal, Any], list[Array]] = {}
    for number in numbers:
        value, legal = number.value, number.legal
        if value is None:
            continue
        if not isinstance(value, Tracer):
            illegal.append(not np.all(legal.holds(np.asarray(value))))
        elif value.ndim > 0 and value.size <= _SMALL:
            small.setdefault((legal, value.dtype), []).append(value.reshape(-1))
        else:
            illegal.append(~jnp.all(legal.holds(value)))
    # One reduction for all small arrays of a kind: each costs as much as a thousand comparisons.
    illegal += [~jnp.all(legal.holds(jnp.concatenate(parts))) for (legal, _), parts in small.items()]
    return functools.reduce(jnp.logical_or, illegal)


def check_number(name: str, value: Any, legal: Legal, remedy: str) -> None:
    """``check_numbers`` of one number."""
    check_numbers([Number(name, value, legal, remedy)])


def static_number(name: str, value: Any, legal: Legal, remedy: str) -> float:
    """A number that is part of a program's structure, checked, as a Python float."""
    if isinstance(value, Tracer):
        raise ValueError(f"{name} is traced, but is part of the compiled program: give a number known before jit")
    check_number(name, value, legal, remedy)
    if np.ndim(value):
        raise ValueError(f"{name} has shape {np.shape(value)}: give one number")
    return float(value)


def whole_number(name: str, value: Any, least: int, remedy: str) -> int:
    """A count, checked, as a Python int."""
    try:
        whole = int(value)
        legal = whole == value and whole >= least
    except (TypeError, ValueError, OverflowError):
        legal = False
    if not legal:
        raise ValueError(f"{name} is {value!r}: {remedy}")
    return whole  # pyright: ignore[reportPossiblyUnboundVariable]


def check_enum(name: str, value: Any, kind: type[enum.Enum]) -> None:
    """Raises ValueError unless the value is a member of the enum. The message lists the members."""
    if not isinstance(value, kind):
        members = ", ".join(str(member) for member in kind)
        raise ValueError(f"{name} is {value!r}: give one of {members}")


def _as_array(number: Number) -> np.ndarray:
    if number.value is None:
        raise ValueError(f"{number.name} is None, but must be {number.legal}: {number.remedy}")
    try:
        array = np.asarray(number.value)
    except (TypeError, ValueError):
        array = np.asarray(None)
    if not (jnp.issubdtype(array.dtype, jnp.number) or array.dtype == bool) or np.iscomplexobj(array):
        raise ValueError(f"{number.name} is {number.value!r}, which is no real number: {number.remedy}")
    return array


def _sentence(number: Number, array: np.ndarray, bad: np.ndarray) -> str:
    where, value = "", array[()]
    if array.ndim:
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        where, value = f"[{', '.join(map(str, index))}]", array[index]
    must = str(number.legal)
    if must != "finite" and not np.isfinite(value):
        must += " and finite"
    return f"{number.name}{where} is {value!s}, but must be {must}: {number.remedy}"
