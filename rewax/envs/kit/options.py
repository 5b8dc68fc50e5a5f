"""Options that ``rewax.make`` passes to a task: checks of numbers and flags, and substeps that fill a control step."""

from typing import Any, NamedTuple

import numpy as np
from jax.core import Tracer

from rewax.physics.numerics.checks import POSITIVE, Legal, check_number, described, static_number

_OTHER_VALUES = "rewax.replace_leaf(env, name, value) takes arrays"
_TOLERANCE, _MOST_SUBSTEPS = 1e-6, 1_000_000
"""Relative error with which a substep may divide the control step: what rounding of seven digits leaves."""


class Substeps(NamedTuple):
    """How a control step is divided.

    Attributes:
      dt: duration of a substep [s].
      num: substeps per control step.
      list_every: substeps for which one list of active nodes serves; None: a whole control step.
    """

    dt: float
    num: int
    list_every: int | None = None


def substeps(dt: float | None, num_substeps: int | None, default: Substeps) -> Substeps:
    """The substeps of a task whose caller gave a substep, a number of substeps, both, or neither.

    The control step keeps its duration unless both are given: it then lasts ``num_substeps * dt``. A list of active
    nodes serves for the same time as by default, or for less where that time is no divisor of the control step.

    Args:
      dt: duration of a substep [s], or None.
      num_substeps: substeps per control step, or None.
      default: the substeps of the task at its scale. They are returned unchanged where both arguments are None.

    Raises:
      ValueError: an argument is no positive number, num_substeps is no integer, or dt does not divide the control step.
    """
    if dt is None and num_substeps is None:
        return default
    num = default.num
    if num_substeps is not None:
        num = integer_option("num_substeps", num_substeps, "give the number of substeps in a control step")
        if num == default.num and dt is None:
            return default
    control_dt = default.num * default.dt
    if dt is None:
        dt = control_dt / num
    else:
        check_is_no_flag("dt", dt)
        dt = static_number("dt", dt, POSITIVE, "give the duration of a substep in seconds")
        if control_dt > _MOST_SUBSTEPS * dt:
            raise ValueError(
                f"dt is {dt:g} s, of which a control step of {control_dt:g} s has {control_dt / dt:.3g}: give at least "
                f"{control_dt / _MOST_SUBSTEPS:.3g} s"
            )
    if num_substeps is None:
        num = max(1, round(control_dt / dt))
        if abs(num * dt - control_dt) > _TOLERANCE * control_dt:
            raise ValueError(
                f"dt is {dt:g} s, which does not divide the control step of {control_dt:g} s: give num_substeps="
                f"{-int(-control_dt // dt)}, for example, or both dt and num_substeps for another control step"
            )
    return Substeps(dt, num, _list_every(default, dt, num))


def number_option(name: str, value: Any, legal: Legal = POSITIVE, *, remedy: str) -> Any:
    """The value of an option that is one real number, unchanged. A traced scalar is such a number too.

    Raises:
      ValueError: the value is of another type or shape, or is illegal.
    """
    check_is_no_flag(name, value)
    if not isinstance(value, Tracer):
        check_number(name, value, legal, remedy)
    if np.shape(value) != ():
        raise ValueError(f"{name} has shape {np.shape(value)}: give one number; {_OTHER_VALUES}")
    return value


def integer_option(name: str, value: Any, remedy: str) -> int:
    """The value of an option that is an integer of at least 1.

    Raises:
      ValueError: it is something else.
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name} is {described(value)}, but must be an integer of at least 1: {remedy}")
    return int(value)


def flag_option(name: str, value: Any) -> bool:
    """The value of an option that is True or False.

    Raises:
      ValueError: it is something else.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} is {described(value)}: give True or False")
    return bool(value)


def check_is_no_flag(name: str, value: Any) -> None:
    """Raises ValueError for a boolean where a number is expected, which Python would take for 0 or 1."""
    if isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} is {value!r}, which is no real number: give a number")


def _list_every(default: Substeps, dt: float, num: int) -> int | None:
    """The largest divisor of ``num`` whose substeps last no longer than a list of active nodes serves by default."""
    if default.list_every is None:
        return None
    most = int(default.list_every * default.dt / dt * (1.0 + _TOLERANCE))
    return max(n for n in range(1, num + 1) if num % n == 0 and (n <= most or n == 1))


__all__ = ["Substeps", "check_is_no_flag", "flag_option", "integer_option", "number_option", "substeps"]
