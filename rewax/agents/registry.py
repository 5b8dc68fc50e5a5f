"""Algorithms by name."""

import difflib
from collections.abc import Callable
from typing import Any, NamedTuple

from rewax.agents.base import Agent


class Algorithm(NamedTuple):
    """What training, the command line and saved runs need to know of an algorithm.

    Attributes:
      make: ``(env, config) -> Agent``; keyword ``randomize`` as for ``make_sapo``.
      config_type: frozen dataclass of hyper-parameters, with ``num_envs``, ``horizon`` and ``num_iterations``.
      preset: ``(env_name, scale) -> config``, tuned where there is something tuned.
    """

    make: Callable[..., Agent]
    config_type: type
    preset: Callable[[str, str], Any]


def _sapo() -> Algorithm:
    from rewax.agents.presets import sapo_preset
    from rewax.agents.sapo import SAPOConfig, make_sapo

    return Algorithm(make_sapo, SAPOConfig, sapo_preset)


_ALGORITHMS: dict[str, Callable[[], Algorithm]] = {"sapo": _sapo}


def register_algorithm(name: str, algorithm: Algorithm) -> None:
    """Make an algorithm known to the command line and to ``load_run``.

    Args:
      name: what users call it; ``Agent.name`` of the agents it makes.
      algorithm: see there.

    Raises:
      ValueError: the name is taken by another algorithm.
    """
    if name in _ALGORITHMS and _ALGORITHMS[name]() != algorithm:
        raise ValueError(f"an algorithm named {name!r} is registered already: choose another name")
    _ALGORITHMS[name] = lambda: algorithm


def list_algorithms() -> list[str]:
    """Names that ``algorithm`` knows, sorted."""
    return sorted(_ALGORITHMS)


def algorithm(name: str) -> Algorithm:
    """A registered algorithm.

    Raises:
      ValueError: there is none of that name; the message lists what there is.
    """
    if name not in _ALGORITHMS:
        close = difflib.get_close_matches(name, _ALGORITHMS, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise ValueError(f"there is no algorithm named {name!r}: {hint}known are {', '.join(list_algorithms())}")
    return _ALGORITHMS[name]()


def make_agent(name: str, env: Any, config: Any = None, **kwargs: Any) -> Agent:
    """An agent of a registered algorithm; ``config`` defaults to the algorithm's own defaults."""
    known = algorithm(name)
    return known.make(env, known.config_type() if config is None else config, **kwargs)
