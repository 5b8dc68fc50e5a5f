"""Checks of numbers that a user gives.

A ``Number`` states the legal values of a field. ``check_numbers`` raises an error for illegal concrete values, when a
scene is built. ``any_illegal`` tests traced values inside compiled programs and costs a few comparisons.
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
    """Lower limit; illegal itself, unless ``closed``."""
    high: float = math.inf
    """Upper limit; illegal itself."""
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
        if self == PROBABILITY:
            return "from 0 to 1"
        return "finite" if self == FINITE else f"above {self.low:.5g} and below {self.high:.5g}"


_SMALL = 1024
"""Arrays up to this size are concatenated before they are compared."""
POSITIVE = Legal(low=0.0)
"""Finite numbers above 0."""
NOT_NEGATIVE = Legal(low=0.0, closed=True)
"""Finite numbers of at least 0."""
FINITE = Legal()
"""All finite numbers."""
PROBABILITY = Legal(low=0.0, high=1.0 + 2.0**-23, closed=True)  # the next number of float32: 1 itself is legal
"""Numbers from 0 to 1."""
GRAVITY = "give an acceleration in m/s^2, (0, -9.81, 0) on Earth"
"""The remedy in messages about gravity."""


class Number(NamedTuple):
    """A field that holds a number or an array of them."""

    name: str
    """Its name in messages."""
    value: Any
    legal: Legal
    remedy: str
    """The end of messages: what to give instead."""
    shape: tuple[int | str, ...] | None = None
    """The shape that the value must have, with a name for each axis of any length; None: any shape."""


def numbers_of(tree: Any, prefix: str = "") -> list[Number]:
    """The fields of an object that ``struct.number`` declares, with their legal values.

    A field that is None is left out if None is its default.

    Args:
      tree: an object of a ``struct.dataclass``.
      prefix: text before the field names in messages.
    """
    found = []
    for field in dataclasses.fields(tree):
        if (rule := field.metadata.get("number")) is None:
            continue
        value = getattr(tree, field.name)
        if value is not None or field.default is not None:
            found.append(Number(prefix + field.name, value, *rule))
    return found


def unit_vectors(name: str, value: Any) -> list[Number]:
    """The squared lengths of vectors of shape (..., 3), with their legal values; none if there are no numbers.

    Args:
      name: of the vectors in messages.
      value: the vectors.
    """
    vectors = value if isinstance(value, Tracer) else as_array(value)
    if not jnp.issubdtype(vectors.dtype, jnp.number):
        return []
    squares = (vectors**2).sum(axis=-1)
    return [Number(f"the squared length of {name}", squares, Legal(1.0 - 2e-4, 1.0 + 2e-4), "give unit vectors")]


def friction_dampings(name: str, friction_damping: Any, *frictions: Any) -> list[Number]:
    """The friction damping [N s/m] where something rubs, with its legal values; none if these are no numbers.

    Below Coulomb's limit friction is ``friction_damping`` times the sliding speed: with 0 a friction coefficient would
    have neither an effect nor a gradient.

    Args:
      name: of the damping in messages.
      friction_damping: one number, or one per vertex.
      frictions: Coulomb coefficients [-], likewise.
    """
    values = (friction_damping, *frictions)
    xp = jnp if any(isinstance(value, Tracer) for value in values) else np
    arrays = [value if isinstance(value, Tracer) else as_array(value) for value in values]
    vertices = {array.shape for array in arrays} - {()}
    if not all(jnp.issubdtype(array.dtype, jnp.number) for array in arrays) or len(vertices) > 1:
        return []
    rubs = functools.reduce(xp.logical_or, [array > 0 for array in arrays[1:]], np.False_)
    # Single vertices may slide freely: a damping of 0 is how they do at colliders, whose friction is one number.
    largest = xp.where(xp.any(rubs), xp.max(xp.where(rubs, arrays[0], 0.0)), 1.0)
    remedy = "give a number of N s/m, about the mass of a vertex or particle over dt, or a friction of 0"
    return [Number(f"{name} with friction", largest, POSITIVE, remedy)]


def check_numbers(numbers: Iterable[Number]) -> None:
    """Raises ValueError for the first illegal number. The message names field, value and remedy.

    Of traced numbers only the shape is checked.
    """
    for number in numbers:
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(number.value)):
            array = _traced_array(number)
        else:
            array = _real_array(number)
            holds = number.legal.holds(array)
            if not np.all(holds):
                raise ValueError(_sentence(number, array, ~holds))
        if number.shape is not None and not fits(array.shape, number.shape):
            form = f"an array of shape ({_listed(number.shape)})" if number.shape else "one number"
            raise ValueError(f"{number.name} has shape {array.shape}: give {form}")


def any_illegal(numbers: Iterable[Number]) -> Array:
    """Whether any of the numbers is illegal, shape (), bool. Numbers that are None are skipped. Gradient: none.

    Concrete values are compared while tracing and add nothing to the program.
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
    # One reduction per kind: a reduction costs as much as a thousand comparisons.
    illegal += [~jnp.all(legal.holds(jnp.concatenate(parts))) for (legal, _), parts in small.items()]
    return functools.reduce(jnp.logical_or, illegal)


def check_number(name: str, value: Any, legal: Legal, remedy: str) -> None:
    """``check_numbers`` of one number."""
    check_numbers([Number(name, value, legal, remedy)])


def static_number(name: str, value: Any, legal: Legal, remedy: str) -> float:
    """A number that is part of the program, checked, as a Python float."""
    if isinstance(value, Tracer):
        raise ValueError(f"{name} is traced, but is part of the compiled program: give a number known before jit")
    check_number(name, value, legal, remedy)
    if np.ndim(value):
        raise ValueError(f"{name} has shape {np.shape(value)}: give one number")
    return float(value)


def static_integer(name: str, value: Any, least: int, remedy: str) -> int:
    """An integer, checked, as a Python int. Booleans are no integers."""
    number = 0
    try:
        number = int(value)
        legal = number == value and least <= number < 2**31 and not isinstance(value, (bool, np.bool_))
    except (TypeError, ValueError, OverflowError):
        legal = False
    if not legal:
        raise ValueError(f"{name} is {shown(value)}: {remedy}")
    return number


def check_precision(x: Array, *others: Array) -> None:
    """Raises ValueError if arithmetic with the others would change the precision of a state's array x."""
    wide = jnp.result_type(x, *others)
    if wide != x.dtype:
        raise ValueError(
            f"the state has numbers of {x.dtype}, but the scene or the poses of {wide}: make both while "
            f"jax.enable_x64 is on or both while it is off, or give a state of {wide}"
        )


def check_enum(name: str, value: Any, kind: type[enum.Enum]) -> None:
    """Raises ValueError unless the value is a member of the enum. The message lists the members."""
    if not isinstance(value, kind):
        members = ", ".join(str(member) for member in kind)
        raise ValueError(f"{name} is {shown(value)}: give one of {members}")


def shown(value: Any) -> str:
    """A value in a message, on one line of at most 100 characters."""
    if isinstance(value, (np.ndarray, jax.Array)) and value.ndim and value.size > 4:
        return f"an array of {value.dtype} of shape {value.shape}"
    text = " ".join(repr(value).split())
    return text if len(text) <= 100 else f"{text[:97]}..."


def described(value: Any) -> str:
    """A value in a message: numbers and strings themselves, arrays by type and shape, other objects by type."""
    if isinstance(value, (jax.Array, np.ndarray)):
        return f"an array of {value.dtype} of shape {value.shape}"
    if isinstance(value, tuple) and type(value) is tuple:
        return f"a tuple of {len(value)}"
    return repr(value) if isinstance(value, (bool, int, float, str, type(None))) else f"a {type(value).__name__}"


def _real_array(number: Number) -> np.ndarray:
    if number.value is None:
        raise ValueError(f"{number.name} is None, but must be {number.legal}: {number.remedy}")
    is_empty = isinstance(number.value, (tuple, list)) and len(number.value) == 0
    array = as_array(None if is_empty else number.value)
    if not jnp.issubdtype(array.dtype, jnp.number) or np.iscomplexobj(array):
        raise ValueError(f"{number.name} is {shown(number.value)}, which is no real number: {number.remedy}")
    return array


def _traced_array(number: Number) -> Array:
    try:
        return jnp.asarray(number.value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{number.name} is {shown(number.value)}, which is no array: {number.remedy}") from error


def as_array(value: Any) -> np.ndarray:
    """The value as a NumPy array; an array of None if it is none."""
    try:
        return np.asarray(value)
    except (TypeError, ValueError):
        return np.asarray(None)


def fits(shape: tuple[int, ...], wanted: tuple[int | str, ...]) -> bool:
    """Whether an array has the wanted shape; a named axis has any length."""
    return len(shape) == len(wanted) and all(isinstance(w, str) or n == w for n, w in zip(shape, wanted, strict=True))


def _listed(shape: tuple[int | str, ...]) -> str:
    return ", ".join(map(str, shape)) + "," * (len(shape) == 1)


def _sentence(number: Number, array: np.ndarray, bad: np.ndarray) -> str:
    where, value = "", array[()]
    if array.ndim:
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        where, value = f"[{', '.join(map(str, index))}]", array[index]
    must = str(number.legal)
    if must != "finite" and not np.isfinite(value):
        must += " and finite"
    return f"{number.name}{where} is {value!s}, but must be {must}: {number.remedy}"
