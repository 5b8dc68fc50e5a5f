"""Short texts of objects that hold arrays: what ``repr`` of a ``rewax.struct.dataclass`` prints."""

import dataclasses
import enum
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

_MOST_NUMBERS = 4
"""Arrays of at most so many numbers are printed with their values."""
_MOST_ITEMS = 6
"""Entries of a dict, tuple or list that are printed; the rest is counted."""
_MOST_OBJECTS = 2
"""The same for tuples and lists of dataclasses."""
_MOST_CHARACTERS = 80
"""Longest text of any other object, in characters."""


def short_repr(tree: Any, *, first: Sequence[str] = ()) -> str:
    """``Name(field=value, ...)`` of a dataclass: arrays by type and shape, short ones by value, None left out.

    ``first`` are further entries, which precede the fields.
    """
    values = ((field.name, getattr(tree, field.name, None)) for field in dataclasses.fields(tree))
    entries = [*first, *(f"{name}={_text(v)}" for name, v in values if v is not None)]
    return f"{type(tree).__name__}({', '.join(entries)})"


def _text(value: Any) -> str:
    if dataclasses.is_dataclass(value) or isinstance(value, (str, type(None))):
        return repr(value)
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return _array(value)
    if isinstance(value, enum.Enum):
        return str(value)
    if isinstance(value, dict):
        return _listed([f"{key!r}: {_text(each)}" for key, each in value.items()], "{}", _MOST_ITEMS)
    if isinstance(value, (tuple, list)):
        objects = len(value) > 3 and any(dataclasses.is_dataclass(each) for each in value)
        most = _MOST_OBJECTS if objects else _MOST_ITEMS
        return _listed([_text(each) for each in value], "[]" if isinstance(value, list) else "()", most)
    text = repr(value)
    return text if len(text) <= _MOST_CHARACTERS else f"{text[: _MOST_CHARACTERS - 4]} ..."


def _array(array: Any) -> str:
    kind = f"{array.dtype}[{','.join(map(str, array.shape))}]"
    is_known = isinstance(array, (jax.Array, np.ndarray, np.generic)) and not isinstance(array, Tracer)
    if not is_known or jnp.issubdtype(array.dtype, jax.dtypes.prng_key) or array.dtype.kind not in "biuf":
        return kind
    if array.size > _MOST_NUMBERS or array.ndim > 1:
        return kind
    numbers = [f"{x:.6g}" if array.dtype.kind == "f" else str(x) for x in np.asarray(array).reshape(-1)]
    return f"[{', '.join(numbers)}]" if array.ndim else numbers[0]


def _listed(items: list[str], brackets: str, most: int) -> str:
    shown = items[:most]
    if len(items) > most:
        shown.append(f"... {len(items) - most} more")
    single = "," if brackets == "()" and len(items) == 1 else ""
    return brackets[0] + ", ".join(shown) + single + brackets[1]


__all__ = ["short_repr"]
