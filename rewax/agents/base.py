"""What an algorithm is to the training loop."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax

from rewax.envs.leaves import EnvLeaves, strongly_typed
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
      train_step: ``TrainState -> (TrainState, Metrics)``; one iteration, jitted. The input stays usable unless
        ``consumes`` says otherwise.
      policy: ``(TrainState, obs, key, deterministic=False) -> action`` for one environment; ``vmap`` over obs and key.
      name: of the algorithm in ``rewax.agents.registry``; empty for one that is not registered.
      config: its frozen dataclass of hyper-parameters.
      consumes: ``train_step`` changes its input in place: it cannot be used afterwards.
    """

    init: Callable[[Key], Any]
    train_step: Callable[[Any], tuple[Any, Metrics]]
    policy: Callable[..., Array]
    name: str = ""
    config: Any = None
    consumes: bool = False


Init: TypeAlias = Callable[[Any, EnvLeaves, Key], TrainState]
TrainStep: TypeAlias = Callable[[Any, TrainState], tuple[TrainState, Metrics]]


def bind(
    name: str,
    config: Any,
    leaves: EnvLeaves,
    *,
    init: Init,
    train_step: TrainStep,
    policy: Callable[..., Array],
    donate: bool = False,
) -> Agent:
    """An agent from pure functions of its configuration.

    Agents of equal configurations share their compiled programs: environments whose leaves have other values compile
    nothing.

    Args:
      name: of the algorithm.
      config: hashable.
      leaves: of the environment.
      init: ``(config, leaves, key) -> TrainState``.
      train_step: ``(config, TrainState) -> (TrainState, Metrics)``.
      policy: as for ``Agent``.
      donate: ``train_step`` may reuse the memory of its input.
    """
    start, step = _compiled(init, config, True), _compiled(train_step, config, donate=donate)
    return Agent(
        init=lambda key: start(leaves, key),
        train_step=step,
        policy=policy,
        name=name,
        config=config,
        consumes=donate,
    )


@functools.cache
def _compiled(function: Callable[..., Any], config: Any, fix_types: bool = False, donate: bool = False) -> Any:
    """``function`` with its first argument fixed, jitted; once per configuration."""

    def program(*args: Any) -> Any:
        out = function(config, *args)
        # A run's first state has the types of all later ones, so that train_step is compiled once.
        return jax.tree.map(strongly_typed, out) if fix_types else out

    return jax.jit(program, donate_argnums=0 if donate else ())
