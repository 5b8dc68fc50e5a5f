"""The state of a run: environments, learnt parameters, counters."""

from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, Self, TypeVar

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.agents.base import Metrics
from rewax.agents.config import PolicyOptions, RunConfig
from rewax.agents.devices import sharded
from rewax.agents.episodes import episode_metrics, running_returns
from rewax.agents.normalization import RunningStatistics, init_statistics, update_statistics
from rewax.agents.rollout import Transition
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.memory import MEMORY, Remembering, check_no_memory
from rewax.envs.randomized import Randomize, Randomized, check_hook
from rewax.envs.registry import require_env
from rewax.envs.wrappers import AutoReset, Vmap, is_or_contains
from rewax.types import Array, Key, Observation, PyTree

T = TypeVar("T")

_ABSENT: Any = None
"""Replaces the fields of ``Environments`` that ``common()`` leaves out; they must not be read there."""


@struct.dataclass
class Environments(struct.Replaceable):
    """``num_envs`` environments side by side, and the statistics of their observations.

    Attributes:
      env: the environments' parameters. They are data, not constants of a compiled program. ``env.replace(arrays=...)``
        sets other values, ``EnvLeaves.of(env)`` takes those of another environment.
      state: states behind ``AutoReset``, leading axis (num_envs,).
      statistics: running statistics of the vector observations.
      episode_return: returns so far of the running episodes, shape (num_envs,); NaN where the beginning is unknown.
    """

    env: EnvLeaves
    state: State
    statistics: RunningStatistics
    episode_return: Array

    @property
    def num_envs(self) -> int:
        return self.episode_return.shape[0]

    def first_observation(self) -> Observation:
        """The first environment's observation, used to initialise networks."""
        return jax.tree.map(lambda a: a[0], self.state.obs)

    def split(self, key: Key) -> Key:
        """A key for each environment."""
        return jax.random.split(key, self.num_envs)

    def map(self, function: Callable[..., T], shared: PyTree, *args: PyTree) -> T:
        """``function(shared, env, state, *args)``, mapped over all environments behind ``AutoReset``.

        Args:
          function: function of one environment. It must not close over arrays, see ``sharded``.
          shared: argument that all environments share.
          args: trees with a leading axis of environments.
        """
        axes = (None, self.env.axis, 0, *[0] * len(args))
        mapped = jax.vmap(lambda shared, env, *rest: function(shared, AutoReset(env=env.build()), *rest), axes)
        return sharded(mapped, (shared, self.env.replace(axis=None), self.state, *args), [axis == 0 for axis in axes])

    def common(self) -> "Environments":
        """The parts that all environments share: the statistics. All other fields are None."""
        return self.replace(env=_ABSENT, state=_ABSENT, episode_return=_ABSENT)

    def restarted(self, key: Key) -> "Environments":
        """All environments at the beginning of new episodes."""
        return self.replace(state=_reset(self.env, self.split(key)), episode_return=jnp.zeros_like(self.episode_return))

    def after(self, config: RunConfig, end: State, transitions: Transition) -> "Environments":
        """The environments after a rollout of all of them, leading axes (num_envs, horizon)."""
        statistics = self.statistics
        if _normalizes(config):
            # Exclude rollouts with a failed step from the statistics.
            healthy = ~jnp.any(transitions.failed, axis=1, keepdims=True)
            statistics = update_statistics(statistics, transitions.obs, transitions.active & healthy)
        return self.replace(
            state=end, statistics=statistics, episode_return=running_returns(self.episode_return, transitions)[0]
        )


@struct.dataclass
class RunState(struct.Replaceable):
    """The complete state of a run; this is what a checkpoint stores.

    Attributes:
      environments: the environments, with the statistics of their observations.
      key: the source of randomness.
      iteration, env_steps: number of iterations and of control steps so far, shape (), int32.
    """

    environments: Environments
    key: Key
    iteration: Array = struct.field(default_factory=lambda: jnp.zeros((), jnp.int32))
    env_steps: Array = struct.field(default_factory=lambda: jnp.zeros((), jnp.int32))

    def common(self) -> Self:
        """The state without the fields that differ between environments; ``Environments.common()``."""
        return self.replace(environments=self.environments.common())

    def restarted(self, config: Hashable) -> Self:
        """The state with environments in new episodes: at random times of them if ``config`` staggers episodes."""
        key, reset_key, stagger_key = jax.random.split(self.key, 3)
        environments = self.environments.restarted(reset_key)
        if _staggers(config):
            environments = staggered(environments, stagger_key)
        return self.replace(environments=environments, key=key)

    def after(self, config: RunConfig, end: State, transitions: Transition, key: Key) -> tuple[Self, Metrics]:
        """The state after an iteration, with updated environments and counters; and the metrics of the episodes.

        Args:
          config: the run's configuration.
          end: states of the environments after the rollout, leading axis (num_envs,).
          transitions: the rollout's transitions, leading axes (num_envs, horizon).
          key: key of the next iteration.
        """
        new = self.replace(
            environments=self.environments.after(config, end, transitions),
            key=key,
            iteration=self.iteration + 1,
            env_steps=self.env_steps + jnp.sum(transitions.active, dtype=jnp.int32),
        )
        return new, episode_metrics(self.environments.episode_return, transitions)


@struct.dataclass
class PolicyState(RunState):
    """The state of an algorithm with a policy network.

    Attributes:
      actor_params, actor_opt: parameters of the policy, and the state of their optimizer.
    """

    actor_params: PyTree
    actor_opt: PyTree


@struct.dataclass
class ActorCriticState(PolicyState):
    """The state of an algorithm with critics that have their own optimizer.

    Attributes:
      critic_params, critic_opt: parameters of the critics, and the state of their optimizer.
      target_params: parameters of the target network; None: there is none.
    """

    critic_params: PyTree
    critic_opt: PyTree
    target_params: PyTree


class RunKeys(NamedTuple):
    """Keys for the parts of a run's first state."""

    run: Key
    actor: Key
    critics: Key
    environments: Key
    stagger: Key


def run_keys(key: Key) -> RunKeys:
    """Independent keys from the key of a run."""
    return RunKeys(*jax.random.split(key, 5))


def partition(env: Env, num_envs: int, randomize: Randomize | None = None, *, memory: int = 0) -> EnvLeaves:
    """The parameters of an environment, or of a batch (``Vmap(env=..., env_axis=0)``), separated from its program.

    With ``memory`` > 0 the environments carry a memory of this size.

    Raises:
      ValueError: ``env`` is no environment, the batch size is not ``num_envs``, the environment resets by itself, or
        ``randomize`` or ``memory`` does not fit it.
    """
    require_env(env)
    if is_or_contains(env, AutoReset):
        raise ValueError("env has an AutoReset, but agents reset by themselves: give the environment without AutoReset")
    batched = isinstance(env, Vmap) and env.env_axis is not None
    one: Any = env.env if batched else env  # type: ignore[attr-defined]
    if randomize is not None:
        check_hook(EnvLeaves.of(env).first(), randomize)
        one = Randomized(env=one, randomize=randomize)
    if memory:
        check_no_memory(EnvLeaves.of(env).first())
        one = Remembering(env=one, size=memory)
    if randomize is not None or memory:
        env = Vmap(env=one, env_axis=0) if batched else one
    leaves = EnvLeaves.of(env)
    leaves.check_size(num_envs)
    return leaves


def start_environments(config: RunConfig, env: EnvLeaves, keys: RunKeys) -> Environments:
    """Environments at the beginning of a run.

    Args:
      config: with ``stagger_episodes``, environments start at random times of their episodes; with
        ``normalize_observations``, the statistics start with the first observations.
      env: the environments' parameters.
      keys: the run's keys.
    """
    num_envs, first = config.num_envs, env.first()
    remembers = isinstance(config, PolicyOptions) and config.memory > 0
    state = _reset(env, jax.random.split(keys.environments, num_envs))
    seen = {name: spec for name, spec in first.observation_spec.items() if not (remembers and name == MEMORY)}
    statistics = init_statistics(seen)
    if _normalizes(config):
        statistics = update_statistics(statistics, state.obs, jnp.ones(num_envs, bool))
    new = Environments(env=env, state=state, statistics=statistics, episode_return=jnp.zeros(num_envs))
    return staggered(new, keys.stagger) if _staggers(config) else new


def staggered(environments: Environments, key: Key) -> Environments:
    """The same environments with their step counts set to random times of an episode."""
    length = environments.env.first().episode_length
    start = jax.random.randint(key, (environments.num_envs,), 0, length, jnp.int32)
    return environments.replace(
        state=environments.state.replace(step_count=start),
        # The first episode is shortened, so its return would not be comparable.
        episode_return=jnp.where(start > 0, jnp.nan, environments.episode_return),
    )


def _staggers(config: Hashable) -> bool:
    return isinstance(config, PolicyOptions) and config.stagger_episodes


def _normalizes(config: RunConfig) -> bool:
    return isinstance(config, PolicyOptions) and config.normalize_observations


def _reset(env: EnvLeaves, keys: Key) -> State:
    """First states of the environments behind ``AutoReset``, one per key."""
    reset = jax.vmap(lambda env, key: AutoReset(env=env.build()).reset(key), (env.axis, 0))
    return reset(env.replace(axis=None), keys)
