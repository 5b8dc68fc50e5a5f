"""Legal values of options: a part of their types, checked for all configurations by one function.

The type of a field says which values it takes (``bool``, ``int``, ``float``, ``str``, ``Literal``, ``tuple``, or None
beside one of them); ``Annotated[int, COUNT]`` narrows them.
"""

import dataclasses
import functools
import inspect
import math
import os
import types
from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

import numpy as np


class Legal(NamedTuple):
    """Legal values of an option.

    Attributes:
      remedy: what to give instead, a sentence that begins with a verb.
      holds: whether a value is legal.
    """

    remedy: str
    holds: Callable[[Any], bool]

    def __repr__(self) -> str:
        """The remedy alone, so that ``help`` of a configuration stays readable."""
        return f"Legal({self.remedy})"

    def check(self, name: str, value: object) -> None:
        """Raises ValueError unless the value is legal."""
        if not self.holds(value):
            raise ValueError(f"{name} is {value!r}: {self.remedy}")

    def or_none(self, remedy: str) -> "Legal":
        """None is legal too."""
        return Legal(remedy, lambda value: value is None or self.holds(value))


def is_whole(value: object) -> bool:
    """Whether a value is an integer; a boolean is none."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_number(value: object) -> bool:
    """Whether a value is a finite number; a boolean is none."""
    return (isinstance(value, float) or is_whole(value)) and math.isfinite(value)  # type: ignore[arg-type]


COUNT = Legal("give an integer of at least 1", lambda v: is_whole(v) and v >= 1)
AT_LEAST_2 = Legal("give an integer of at least 2", lambda v: is_whole(v) and v >= 2)
NATURAL = Legal("give an integer of at least 0", lambda v: is_whole(v) and v >= 0)
SEED = Legal("give an integer from 0 to 4294967295", lambda v: is_whole(v) and 0 <= v < 2**32)
SHARE = Legal("give a number between 0 and 1", lambda v: is_number(v) and 0.0 <= v <= 1.0)
DECAY = Legal("give a number of at least 0 and below 1", lambda v: is_number(v) and 0.0 <= v < 1.0)
POSITIVE = Legal("give a positive number", lambda v: is_number(v) and v > 0.0)
NON_NEGATIVE = Legal("give a number of at least 0", lambda v: is_number(v) and v >= 0.0)
WIDTHS = Legal("give integers of at least 2", lambda v: isinstance(v, tuple) and all(map(AT_LEAST_2.holds, v)))
NONE_OR_2 = Legal("give 0, or an integer of at least 2", lambda v: AT_LEAST_2.holds(v) or (is_whole(v) and v == 0))
INTERVAL = Legal(
    "give two numbers in ascending order",
    lambda v: isinstance(v, tuple) and len(v) == 2 and all(map(is_number, v)) and v[0] <= v[1],
)

Count = Annotated[int, COUNT]
Natural = Annotated[int, NATURAL]
Seed = Annotated[int, SEED]
Share = Annotated[float, SHARE]
Decay = Annotated[float, DECAY]
Positive = Annotated[float, POSITIVE]
NonNegative = Annotated[float, NON_NEGATIVE]
Widths = Annotated[tuple[int, ...], WIDTHS]
"""Sizes of layers. A layer of one number would be blind: its LayerNorm subtracts the mean, which is the number."""
Features = Annotated[int, AT_LEAST_2]
FeaturesOrNone = Annotated[int, NONE_OR_2]
Interval = Annotated[tuple[float, float], INTERVAL]

EnvLimit = Annotated[
    float | Literal["median"] | None,
    Legal(
        "give a positive number, median, or None for no limit",
        lambda v: v is None or POSITIVE.holds(v) or (isinstance(v, str) and v == "median"),
    ),
]
"""Norm to which each environment's gradient is clipped; ``"median"``: that of the environments' norms above 0."""

_PLAIN = {
    bool: Legal("give True or False", lambda v: isinstance(v, bool)),
    int: Legal("give an integer", is_whole),
    float: Legal("give a number", is_number),
    str: Legal("give text", lambda v: isinstance(v, str)),
}


def check_fields(config: Any) -> None:
    """Check every field of a frozen dataclass against its type.

    Lists become tuples, paths text, and NumPy's numbers Python's.

    Raises:
      ValueError: a value is not legal; the message has the field's name, the value and what to give instead.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if isinstance(value, list):
            object.__setattr__(config, field.name, tuple(value))
        elif isinstance(value, os.PathLike):
            object.__setattr__(config, field.name, os.fspath(value))
        elif isinstance(value, np.generic):
            object.__setattr__(config, field.name, value.item())
    for name, legal in legal_values(type(config)).items():
        legal.check(name, getattr(config, name))


@functools.cache
def legal_values(config_type: type) -> dict[str, Legal]:
    """Legal values of the fields of a dataclass.

    A class that gives a field another default keeps the restriction of its bases, unless its own type has another one.
    """
    plain: dict[str, Legal] = {}
    narrowed: dict[str, Legal] = {}
    for part in reversed(config_type.__mro__):
        try:
            hints = inspect.get_annotations(part, eval_str=True)
        except NameError:  # written as a string that only a type checker can resolve
            hints = inspect.get_annotations(part)
        for name, hint in hints.items():
            legal, narrows = _legal(hint)
            if legal is not None:
                (narrowed if narrows else plain)[name] = legal
    names = [field.name for field in dataclasses.fields(config_type)]
    return {name: legal for name in names if (legal := narrowed.get(name) or plain.get(name)) is not None}


def _legal(hint: Any) -> tuple[Legal | None, bool]:
    """Legal values of a type, and whether they are fewer than those of a plain type."""
    if get_origin(hint) is Annotated:
        own = next((extra for extra in hint.__metadata__ if isinstance(extra, Legal)), None)
        return (own, True) if own is not None else _legal(hint.__origin__)
    if get_origin(hint) is Literal:
        choices = get_args(hint)
        remedy = f"use {', '.join(map(str, choices[:-1]))} or {choices[-1]}"
        return Legal(remedy, lambda value: isinstance(value, str) and value in choices), True
    if get_origin(hint) is tuple:
        return _tuple(get_args(hint)), False
    if get_origin(hint) in (Union, types.UnionType):
        parts = [part for part in get_args(hint) if part is not type(None)]
        legal, narrows = _legal(parts[0]) if len(parts) == 1 else (None, False)
        if legal is None or type(None) not in get_args(hint):
            return None, False
        return legal.or_none(f"{legal.remedy}, or None"), narrows
    return _PLAIN.get(hint) if isinstance(hint, type) else None, False


def _tuple(parts: tuple[Any, ...]) -> Legal | None:
    """Legal values of ``tuple[int, ...]`` or ``tuple[float, float]``."""
    if not parts or parts[0] not in _PLAIN or (parts[-1] is not Ellipsis and len(set(parts)) > 1):
        return None
    one, count = _PLAIN[parts[0]], None if parts[-1] is Ellipsis else len(parts)
    what = {int: "integers", float: "numbers", str: "texts", bool: "booleans"}[parts[0]]
    remedy = f"give {'' if count is None else f'{count} '}{what}"
    return Legal(
        remedy, lambda v: isinstance(v, tuple) and all(map(one.holds, v)) and (count is None or len(v) == count)
    )


__all__ = [
    "AT_LEAST_2", "COUNT", "INTERVAL", "NATURAL", "POSITIVE", "Count", "Decay", "EnvLimit", "Features",
    "FeaturesOrNone", "Interval", "Legal", "Natural", "NonNegative", "Positive", "Seed", "Share", "Widths",
    "check_fields", "is_number", "is_whole", "legal_values",
]  # fmt: skip
