"""Checks of arguments that users give. Every failure is one sentence that names argument, value and remedy."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics.checks import as_array, shown, static_integer
from rewax.types import Array


def check_instance(name: str, value: Any, kind: type | tuple[type, ...], remedy: str) -> None:
    """Raises ValueError unless the value is of a type."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} is {shown(value)}: {remedy}")


def check_pytree(name: str, value: Any) -> None:
    """Raises ValueError unless the value's own class is decorated with ``rewax.struct.dataclass``."""
    kind = type(value)
    if "__dataclass_fields__" not in vars(kind):
        raise ValueError(f"{name} is a {kind.__name__}, which is no pytree: decorate it with rewax.struct.dataclass")


def check_integer(name: str, value: Any, least: int, remedy: str | None = None) -> None:
    """Raises ValueError unless the value is an integer of at least ``least`` that fits in 32 bits; a float is none."""
    remedy = remedy or f"give an integer, at least {least}"
    if not (isinstance(value, int) or np.issubdtype(as_array(value).dtype, np.integer)):
        raise ValueError(f"{name} is {shown(value)}: {remedy}")
    static_integer(name, value, least, remedy)


def check_plain(name: str, value: Any, remedy: str) -> None:
    """Raises ValueError for a boolean, or an integer beyond 64 bits, in place of a number."""
    if isinstance(value, (bool, np.bool_)) or getattr(value, "dtype", None) == np.dtype(bool):
        raise ValueError(f"{name} is {shown(value)}, a boolean: {remedy}")
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise ValueError(f"{name} is {shown(value)}, which is too large: {remedy}")


def real_array(name: str, value: Any, remedy: str) -> Array | np.ndarray:
    """The value as an array of real numbers, of any type.

    Raises:
      ValueError: it is none.
    """
    try:
        has_jax = any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value))
        array = jnp.asarray(value) if has_jax else np.asarray(value)
    except (TypeError, ValueError):
        array = None
    if array is None or not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise ValueError(f"{name} is {shown(value)}, which is no array of real numbers: {remedy}")
    return array


__all__ = ["check_instance", "check_integer", "check_plain", "check_pytree", "real_array"]
