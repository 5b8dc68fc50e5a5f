"""Environments by name and scale."""

import difflib
from collections.abc import Callable
from typing import Any

import jax

from rewax.envs.base import Env

Scale = str
SCALES: tuple[Scale, ...] = ("paper", "small")
"""``paper``: the reference's constants, for an accelerator. ``small``: made to learn within minutes on two cores."""

_FACTORIES: dict[str, Callable[..., Env]] = {}


def register(name: str, factory: Callable[..., Env]) -> None:
    """Make an environment available to ``make`` and to the command line.

    Args:
      name: what users call it.
      factory: called as ``factory(scale=..., **kwargs)``.

    Raises:
      ValueError: the name is taken by another factory.
    """
    if _FACTORIES.get(name, factory) is not factory:
        raise ValueError(f"an environment named {name!r} is registered already: choose another name")
    _FACTORIES[name] = factory


def list_envs() -> list[str]:
    """Names that ``make`` knows, sorted."""
    return sorted(_FACTORIES)


def default_scale() -> Scale:
    """``paper`` where JAX found an accelerator, ``small`` on a CPU."""
    return "small" if jax.default_backend() == "cpu" else "paper"


def make(name: str, *, scale: Scale | None = None, **kwargs: Any) -> Env:
    """Build a registered environment.

    Args:
      name: one of ``list_envs()``.
      scale: ``"paper"``, ``"small"``, or None for what suits the device (``default_scale``).
      **kwargs: passed on to the environment's factory, e.g. physical parameters.

    Raises:
      ValueError: unknown name or scale; the message lists what there is.
    """
    if name not in _FACTORIES:
        close = difflib.get_close_matches(name, _FACTORIES, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise ValueError(f"there is no environment named {name!r}: {hint}known are {', '.join(list_envs())}")
    scale = default_scale() if scale is None else scale
    if scale not in SCALES:
        raise ValueError(f"scale is {scale!r}: use one of {', '.join(map(repr, SCALES))}, or none to follow the device")
    return _FACTORIES[name](scale=scale, **kwargs)
