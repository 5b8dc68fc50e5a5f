"""Checks of numbers that a user gives; values that are being traced cannot be checked and pass."""

from typing import Any

import numpy as np
from jax.core import Tracer

NOT_NEGATIVE = (float(np.nextafter(0.0, -1.0)), np.inf)
"""Limits of ``check_range`` for numbers that may be zero."""


def check_range(name: str, value: Any, limits: tuple[float, float], remedy: str) -> None:
    """Raises ValueError unless all of ``value`` lies strictly between the limits."""
    if isinstance(value, Tracer):
        return
    if value is None or not np.all((np.asarray(value) > limits[0]) & (np.asarray(value) < limits[1])):
        raise ValueError(f"{name} is {value if value is None else np.asarray(value)}: {remedy}")


def check_positive(name: str, value: Any, remedy: str) -> None:
    """Raises ValueError unless all of ``value`` is above zero."""
    if isinstance(value, Tracer):
        return
    if value is None or not np.all(np.asarray(value) > 0):
        shown = value if value is None else np.asarray(value)
        raise ValueError(f"{name} is {shown}, but must be positive: {remedy}")
