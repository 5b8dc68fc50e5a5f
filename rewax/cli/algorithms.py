"""Algorithms by name, imported when they are asked for."""

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

from rewax.envs.registry import did_you_mean


class Algorithm(NamedTuple):
    """What the command line needs of an algorithm.

    Attributes:
      make: ``(env, agent_config) -> Agent``.
      preset: ``(env_name, scale) -> agent_config``, a frozen dataclass with num_envs, horizon and num_iterations.
    """

    make: Callable[[Any, Any], Any]
    preset: Callable[[str, str], Any]


ALGORITHMS: dict[str, Algorithm | tuple[str, str]] = {
    "sapo": ("rewax.agents.sapo:make_sapo", "rewax.agents.presets:sapo_preset"),
}
"""Algorithms, or where to find their two functions."""


def algorithm(name: str) -> Algorithm:
    """An algorithm by name.

    Raises:
      ValueError: there is none of that name.
    """
    if name not in ALGORITHMS:
        raise ValueError(
            f"there is no algorithm named {name!r}: {did_you_mean(name, ALGORITHMS)}known are {', '.join(ALGORITHMS)}"
        )
    return Algorithm(*(_imported(part) for part in ALGORITHMS[name]))


def _imported(part: Any) -> Any:
    if not isinstance(part, str):
        return part
    module, function = part.split(":")
    return getattr(importlib.import_module(module), function)


__all__ = ["ALGORITHMS", "Algorithm", "algorithm"]
