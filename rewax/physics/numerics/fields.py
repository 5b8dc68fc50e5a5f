"""Tables of rules for arguments and fields: each rule names the argument, its value and the remedy if it fails.

A rule is a function ``(name, value)`` that raises ValueError. ``checked`` applies a table of rules to a function,
``check_fields`` to any mapping. Rules check concrete values; of traced arrays they check the shape.

Example:
  >>> @checked(radius=real(POSITIVE, "give a length in metres"), num=integer(1, "give at least 1"))
  ... def points(radius, num): ...
  >>> points(-1.0, 3)
  Traceback (most recent call last):
  ValueError: radius is -1.0, but must be positive: give a length in metres
"""

import enum
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics.arguments import check_instance, check_integer
from rewax.physics.numerics.checks import (
    Legal,
    Number,
    as_array,
    check_enum,
    check_numbers,
    fits,
    shown,
    static_number,
)
from rewax.physics.numerics.pose import Pose

P = ParamSpec("P")
R = TypeVar("R")
Rule: TypeAlias = Callable[[str, Any], Any]


def checked(**rules: Rule) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator: check the arguments of a function by a table of rules before it runs."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def run(*args: P.args, **kwargs: P.kwargs) -> R:
            bound = signature.bind(*args, **kwargs)
            check_fields(rules, bound.arguments)
            return function(*args, **kwargs)

        return run

    return decorate


def check_fields(rules: Mapping[str, Rule], values: Mapping[str, Any], prefix: str = "") -> None:
    """Apply rules to the values of their names; ``prefix`` comes before the names in messages."""
    for name, rule in rules.items():
        if name in values:
            rule(prefix + name, values[name])


def real(legal: Legal, remedy: str, shape: tuple[int | str, ...] | None = ()) -> Rule:
    """A real number, or an array of the given shape (see ``checks.Number``); traced values are legal."""
    return lambda name, value: check_numbers([Number(name, value, legal, remedy, shape)])


def static(legal: Legal, remedy: str) -> Rule:
    """A real number that is part of the program; traced values are illegal."""
    return lambda name, value: static_number(name, value, legal, remedy)


def integer(least: int, remedy: str) -> Rule:
    """An integer of at least ``least``, not traced and no float."""
    return lambda name, value: check_integer(name, value, least, remedy)


def member(kind: type[enum.Enum]) -> Rule:
    """A member of an enum."""
    return lambda name, value: check_enum(name, value, kind)


def instance(kind: type | tuple[type, ...], remedy: str) -> Rule:
    """An object of a class."""
    return lambda name, value: check_instance(name, value, kind, remedy)


def optional(rule: Rule) -> Rule:
    """None, or a value for another rule."""
    return lambda name, value: None if value is None else rule(name, value)


def items(rule: Rule, remedy: str, *, length: int | None = None) -> Rule:
    """A tuple, list or array; ``rule`` checks each item. ``length`` None: any."""

    def check(name: str, value: Any) -> None:
        is_sequence = isinstance(value, (tuple, list)) or np.ndim(as_array(value)) == 1
        if not is_sequence or (length is not None and len(value) != length):
            raise ValueError(f"{name} is {shown(value)}: {remedy}")
        for i, item in enumerate(value):
            rule(f"{name}[{i}]", item)

    return check


def indices(remedy: str, shape: tuple[int | str, ...]) -> Rule:
    """An array of integers of the given shape (see ``checks.Number``)."""

    def rule(name: str, value: Any) -> None:
        array = as_array(value)
        if not np.issubdtype(array.dtype, np.integer) or not fits(array.shape, shape):
            raise ValueError(f"{name} is {shown(value)}: {remedy}")

    return rule


def check_range(name: str, indices: np.ndarray, count: int) -> None:
    """Raises ValueError for indices outside of ``range(count)``."""
    if indices.size and (indices.min() < 0 or indices.max() >= count):
        raise ValueError(
            f"{name} has indices from {indices.min()} to {indices.max()}, but there are {count} vertices: give indices "
            f"from 0 to {count - 1}"
        )


def mask(remedy: str, shape: tuple[int | str, ...]) -> Rule:
    """An array of booleans, or of zeros and ones, of the given shape (see ``checks.Number``)."""

    def rule(name: str, value: Any) -> None:
        array = as_array(value)
        if array.dtype.kind not in "buif" or not fits(array.shape, shape) or not np.isin(array, (0, 1)).all():
            raise ValueError(f"{name} is {shown(value)}: {remedy}")

    return rule


def one_of(*legal: Any) -> Rule:
    """One of a few values."""

    def rule(name: str, value: Any) -> None:
        if isinstance(value, (bool, np.bool_)) or np.ndim(as_array(value)) or value not in legal:
            raise ValueError(f"{name} is {shown(value)}: give {' or '.join(map(str, legal))}")

    return rule


def poses(*axes: str) -> Rule:
    """Poses with leading axes of these names."""

    def rule(name: str, value: Any) -> None:
        if not isinstance(value, Pose):
            raise ValueError(f"{name} is {shown(value)}: give a Pose, static_poses(num_substeps) for no bodies")
        position, rotation = np.shape(value.position), np.shape(value.rotation)
        if not fits(position, (*axes, 3)) or rotation != (*position, 3):
            want = ", ".join(axes)
            raise ValueError(
                f"{name} has positions of shape {position} and rotations of shape {rotation}: give shapes ({want}, 3) "
                f"and ({want}, 3, 3)"
            )

    return rule


def key(name: str, value: Any) -> None:
    """A PRNG key of JAX, typed or raw, possibly traced."""
    is_typed = isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
    is_raw = getattr(value, "dtype", None) == np.uint32 and getattr(value, "ndim", 0) > 0
    if not (is_typed or is_raw):
        raise ValueError(f"{name} is {shown(value)}: give a PRNG key, jax.random.key(0)")


__all__ = [
    "Rule", "check_fields", "check_range", "checked", "indices", "instance", "integer", "items", "key", "mask",
    "member", "one_of", "optional", "poses", "real", "static",
]  # fmt: skip
