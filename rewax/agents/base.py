"""The interface between an algorithm and the training loop: ``Agent``, its state and its metrics."""

import functools
from collections.abc import Callable, Hashable
from typing import Any, Generic, NamedTuple, Protocol, TypeAlias, TypeVar

import jax

from rewax.envs.leaves import EnvLeaves, strongly_typed
from rewax.types import Array, Key, Observation, PyTree

TrainState: TypeAlias = PyTree
"""The complete state of a run: parameters, optimizer states, statistics, environments, keys, counters. A pytree with at
least the fields ``iteration`` and ``env_steps`` (shape (), int32)."""
Metrics: TypeAlias = dict[str, Array]
"""Named scalars of one iteration. Every iteration has the same names."""

S = TypeVar("S")
C = TypeVar("C", bound=Hashable)
T = TypeVar("T")


class Act(Protocol):
    """The type of ``Agent.policy``."""

    def __call__(self, state: TrainState, obs: Observation, key: Key, /, deterministic: bool = False) -> Any:
        """The action for one environment; with memory, ``rewax.envs.memory.Remembered(action, memory)``."""
        ...


class Agent(NamedTuple, Generic[S]):
    """An algorithm bound to an environment and a configuration.

    Attributes:
      init: ``key -> TrainState``.
      train_step: ``TrainState -> (TrainState, Metrics)``; one iteration, jitted. The input stays usable unless
        ``consumes`` is set.
      policy: ``(TrainState, obs, key, deterministic=False) -> action`` for one environment; ``vmap`` over obs and key.
        A policy with memory has the method ``initial_memory()``, see ``rewax.envs.memory``.
      name: the algorithm's name in ``rewax.agents.registry``; empty if it is not registered.
      config: the frozen dataclass of hyper-parameters.
      consumes: ``train_step`` donates its input, which cannot be used afterwards.
    """

    init: Callable[[Key], S]
    train_step: Callable[[S], tuple[S, Metrics]]
    policy: Act
    name: str = ""
    config: Hashable = None
    consumes: bool = False


def bind(
    name: str,
    config: C,
    leaves: EnvLeaves,
    *,
    init: Callable[[C, EnvLeaves, Key], S],
    train_step: Callable[[C, S], tuple[S, Metrics]],
    policy: Act,
    donate: bool = False,
) -> Agent[S]:
    """An agent from pure functions of its configuration.

    Agents with equal configurations share their compiled programs. An environment with other parameter values compiles
    nothing new.

    Args:
      name: the algorithm's name.
      config: hyper-parameters.
      leaves: the environment's parameters.
      init: ``(config, leaves, key) -> TrainState``.
      train_step: ``(config, TrainState) -> (TrainState, Metrics)``.
      policy: see ``Agent``.
      donate: ``train_step`` may reuse the memory of its input.
    """
    start, step = _compiled(init, config, True), _compiled(train_step, config, donate=donate)
    return Agent(lambda key: start(leaves, key), step, policy, name, config, consumes=donate)


@functools.cache
def _compiled(
    function: Callable[..., T], config: Hashable, fix_types: bool = False, donate: bool = False
) -> Callable[..., T]:
    """``function`` with ``config`` bound, jitted. Cached per configuration."""

    def program(*args: PyTree) -> T:
        out = function(config, *args)
        # Strong types from the start, so that train_step is compiled once.
        return jax.tree.map(strongly_typed, out) if fix_types else out

    return jax.jit(program, donate_argnums=0 if donate else ())
