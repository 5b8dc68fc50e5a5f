"""What an algorithm is to the training loop."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

from rewax.types import Array, Key, PyTree

TrainState: TypeAlias = PyTree
"""Everything a run is: parameters, optimizer states, statistics, environments, keys, counters. A pytree with at least
the fields ``iteration`` and ``env_steps`` (shape (), int32)."""
Metrics: TypeAlias = dict[str, Array]
"""Named scalars of one iteration, the same keys every time."""


class Agent(NamedTuple):
    """An algorithm bound to an environment and a configuration.

    Attributes:
      init: ``key -> TrainState``.
      train_step: ``TrainState -> (TrainState, Metrics)``; one iteration, jitted, the input stays usable.
      policy: ``(TrainState, obs, key, deterministic=False) -> action`` for one environment; ``vmap`` over obs and key.
    """

    init: Callable[[Key], Any]
    train_step: Callable[[Any], tuple[Any, Metrics]]
    policy: Callable[..., Array]
