"""Options of XLA's compiler for a CPU, and a pair of them that gives wrong gradients."""

import functools
import os
import warnings
from typing import Any

_OLDER_GENERATOR = "xla_cpu_use_fusion_emitters"
_LEVEL = "xla_backend_optimization_level"

QUICK: dict[str, Any] = {_OLDER_GENERATOR: False, _LEVEL: 1}
"""Select XLA's older code generator with little optimisation, to compile faster; see ``has_older_generator``.

For programs whose loops run in C++; in others, iterations would take a fifth longer than with ``QUICK_IN_XLA``.
"""
QUICK_IN_XLA: dict[str, Any] = {**QUICK, _LEVEL: 3}
"""Select the older code generator with full optimisation."""


def wrong_gradients(flags: str) -> str | None:
    """Tell whether flags select the older code generator without optimisation, whose gradients can be zero.

    In jax 0.10.1 the derivative of a union of a sphere and a box with respect to the sphere's radius is then zero.
    Either flag alone is right.

    Args:
      flags: value of the environment variable ``XLA_FLAGS``.

    Returns:
      A sentence without the remedy, else None.
    """
    older = not is_on(flags, _OLDER_GENERATOR, default=True)
    if older and _chosen(flags).get(_LEVEL) == "0":
        return f"--{_OLDER_GENERATOR}=false together with --{_LEVEL}=0 gives gradients that are wrongly zero"
    return None


def is_on(flags: str, name: str, *, default: bool = False) -> bool:
    """Whether flags turn a switch on. The last mention counts; one without a value turns it on.

    Args:
      flags: value of the environment variable ``XLA_FLAGS``.
      name: of the switch, without dashes.
      default: the answer where flags do not name it.
    """
    value = _chosen(flags).get(name)
    return default if value is None else value.lower() not in ("false", "0")


def _chosen(flags: str) -> dict[str, str]:
    """Values of flags by name; empty for a flag without one."""
    named = (flag.lstrip("-").partition("=") for flag in flags.split())
    return {name: value for name, _, value in named}


def warn_of_wrong_gradients() -> None:
    """Warn if ``XLA_FLAGS`` holds flags that together give wrong gradients."""
    sentence = wrong_gradients(os.environ.get("XLA_FLAGS", ""))
    if sentence is not None:
        warnings.warn(f"XLA_FLAGS: {sentence}: remove one of the two", UserWarning, stacklevel=3)


@functools.cache
def has_older_generator() -> bool:
    """Whether this XLA has the older code generator for a CPU. XLA of jax 0.12 has not."""
    return knows(**QUICK)


def knows(**options: Any) -> bool:
    """Whether this XLA has the options. It raises an error for an option that it does not know."""
    import jax

    try:
        jax.jit(lambda x: x + 1.0).lower(0.0).compile(options)
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return False
    return True


def unoptimised() -> dict[str, Any]:
    """Options of ``jax.jit`` for a program that runs once: the newer code generator, without optimisation."""
    return {_LEVEL: 0} | ({_OLDER_GENERATOR: True} if has_older_generator() else {})


__all__ = [
    "QUICK",
    "QUICK_IN_XLA",
    "has_older_generator",
    "is_on",
    "knows",
    "unoptimised",
    "warn_of_wrong_gradients",
    "wrong_gradients",
]
