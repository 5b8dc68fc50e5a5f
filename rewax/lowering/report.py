"""Reports which rules of a program run in C++, and why others are left to XLA: by warning once, and as a list.

Decisions are made while JAX lowers a program for a CPU, once per compiled program. A program from JAX's cache reports
nothing again.
"""

import contextlib
import functools
import inspect
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

RULES = {"value": "the value", "tangent": "the forward derivative (JVP)", "cotangent": "the reverse derivative (VJP)"}


class LoweringWarning(UserWarning):
    """Warns that a part of a program runs in XLA, slower than in C++."""


class Decision(NamedTuple):
    """Where one rule of one function runs."""

    function: str
    """Module and name of the function."""
    rule: str
    """One of ``RULES``."""
    reason: str | None
    """Why the rule is left to XLA; None: it runs in C++."""

    def __str__(self) -> str:
        where = "C++" if self.reason is None else f"XLA, for {self.reason}"
        return f"{self.function}, {RULES[self.rule]}: {where}"


_listeners: list[tuple[int, list[Decision]]] = []
"""Listening threads, and the decisions that each has received."""
_named: set[Decision] = set()


def note(function: Callable[..., Any] | str, rule: str, reason: str | None) -> None:
    """Reports to the listeners of this thread where a rule runs, and warns once if it runs in XLA."""
    decision = Decision(function if isinstance(function, str) else name_of(function), rule, reason)
    for thread, heard in _listeners:
        if thread == threading.get_ident():
            heard.append(decision)
    if reason is not None and decision not in _named:
        _named.add(decision)
        warnings.warn(
            f"{RULES[rule]} of {decision.function} runs in XLA, slower than in C++: {reason} "
            "(docs/lowering.md says what can be lowered)",
            LoweringWarning,
            stacklevel=2,
        )


@contextlib.contextmanager
def recorded() -> Iterator[list[Decision]]:
    """The decisions of this thread inside the block, in order; a function can occur several times.

    Example:
      >>> with recorded() as decisions:
      ...     jax.jit(env.step).lower(state, action)
      >>> assert not [d for d in decisions if d.reason]
    """
    heard: list[Decision] = []
    listener = (threading.get_ident(), heard)
    _listeners.append(listener)
    try:
        yield heard
    finally:
        _listeners[:] = [other for other in _listeners if other is not listener]


def name_of(function: Callable[..., Any]) -> str:
    """Module and name of a function, without ``<locals>``."""
    inner = inspect.unwrap(function)
    while isinstance(inner, functools.partial):
        inner = inspect.unwrap(inner.func)
    name = getattr(inner, "__qualname__", type(inner).__name__).replace("<locals>.", "")
    return f"{getattr(inner, '__module__', '?')}.{name}"


__all__ = ["RULES", "Decision", "LoweringWarning", "name_of", "note", "recorded"]
