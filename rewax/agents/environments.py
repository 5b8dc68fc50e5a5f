"""The environments of a run: a part of every training state."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.agents.devices import divided
from rewax.agents.normalization import RunningStatistics, init_statistics, update_statistics
from rewax.agents.rollout import Transition
from rewax.envs.base import State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize, Randomized, check_hook
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, PyTree


@struct.dataclass
class Environments(struct.Replaceable):
    """``num_envs`` environments side by side, and what is known of their observations.

    Attributes:
      env: their leaves: data, not constants of a compiled program. Give other values with
        ``env.replace(arrays=...)``, or those of another environment with ``EnvLeaves.of(env)``.
      state: behind ``AutoReset``, leading axis (num_envs,).
      statistics: of the vector observations seen so far.
      episode_return: of the episodes under way; NaN for one whose beginning was not seen, shape (num_envs,).
    """

    env: EnvLeaves
    state: State
    statistics: RunningStatistics
    episode_return: Array

    @property
    def num_envs(self) -> int:
        return self.episode_return.shape[0]

    def split(self, key: Key) -> Key:
        """A key for each environment."""
        return jax.random.split(key, self.num_envs)

    def map(self, function: Callable[..., Any], shared: PyTree, *args: Any) -> Any:
        """``function(shared, env, state, *args)`` of every environment behind ``AutoReset``.

        Args:
          function: of one environment; it closes over nothing that is computed, see ``divided``.
          shared: what is the same for all environments.
          args: trees with a leading axis of environments.
        """
        axes = (None, self.env.axis, 0, *[0] * len(args))
        mapped = jax.vmap(lambda shared, env, *rest: function(shared, AutoReset(env=env.build()), *rest), axes)
        return divided(mapped, (shared, self.env.replace(axis=None), self.state, *args), [axis == 0 for axis in axes])

    def common(self) -> "Environments":
        """What all environments share: the statistics. All else is None."""
        nothing: Any = None
        return self.replace(env=nothing, state=nothing, episode_return=nothing)

    def restarted(self, key: Key) -> "Environments":
        """All environments at the beginning of new episodes."""
        return self.replace(state=_reset(self.env, self.split(key)), episode_return=jnp.zeros_like(self.episode_return))

    def advanced(self, state: State, transitions: Transition, *, learn_statistics: bool) -> "Environments":
        """The environments after a rollout of all of them, leading axes (num_envs, horizon)."""
        statistics = self.statistics
        if learn_statistics:
            # What led to a failure is no typical sample: nothing of that environment's rollout counts.
            healthy = ~jnp.any(transitions.failed, axis=1, keepdims=True)
            statistics = update_statistics(statistics, transitions.obs, transitions.active & healthy)
        return self.replace(
            state=state, statistics=statistics, episode_return=running_returns(self.episode_return, transitions)[0]
        )


def taken_apart(env: Any, num_envs: int, randomize: Randomize | None = None) -> EnvLeaves:
    """An environment, or a batch (``Vmap(env=..., env_axis=0)``), as data of a training state.

    Raises:
      ValueError: a batch of another size than ``num_envs``, or a hook that this environment refuses.
    """
    if randomize is not None:
        batch = getattr(env, "env_axis", None) is not None
        check_hook(EnvLeaves.of(env).first(), randomize)
        wrapped = Randomized(env=env.env if batch else env, randomize=randomize)
        env = env.replace(env=wrapped) if batch else wrapped
    leaves = EnvLeaves.of(env)
    leaves.check_size(num_envs)
    return leaves


def start_environments(
    env: EnvLeaves, key: Key, stagger_key: Key, *, num_envs: int, stagger: bool = False, learn_statistics: bool = True
) -> Environments:
    """Environments at the beginning of a run.

    Args:
      env: their leaves.
      key, stagger_key: draw initial states, and where in their time limit environments start.
      num_envs: how many.
      stagger: start at random points of the time limit, so that environments do not reset together.
      learn_statistics: begin the statistics with the first observations.
    """
    state, first = _reset(env, jax.random.split(key, num_envs)), env.first()
    episode_return = jnp.zeros(num_envs)
    if stagger:
        start = jax.random.randint(stagger_key, (num_envs,), 0, first.episode_length, jnp.int32)
        state = state.replace(step_count=start)
        # A first episode that is cut short has no return that compares with the others'.
        episode_return = jnp.where(start > 0, jnp.nan, episode_return)
    statistics = init_statistics(first.observation_spec)
    if learn_statistics:
        statistics = update_statistics(statistics, state.obs, jnp.ones(num_envs, bool))
    return Environments(env=env, state=state, statistics=statistics, episode_return=episode_return)


def _reset(env: EnvLeaves, keys: Key) -> State:
    """First states of the environments behind ``AutoReset``, one per key."""
    reset = jax.vmap(lambda env, key: AutoReset(env=env.build()).reset(key), (env.axis, 0))
    return reset(env.replace(axis=None), keys)


def running_returns(running: Array, transitions: Transition) -> tuple[Array, Array]:
    """Returns of the episodes under way, and those of the steps that ended one.

    Args:
      running: returns so far, shape (num_envs,); NaN counts as unknown until the episode ends.
      transitions: leading axes (num_envs, horizon).

    Returns:
      The returns under way, shape (num_envs,); and, shape (num_envs, horizon), the whole return where a step ended an
      episode, NaN elsewhere and for episodes that failed numerically.
    """

    def step(carry: Array, inputs: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        reward, done, valid = inputs
        total = carry + reward
        return jnp.where(done, 0.0, total), jnp.where(done & valid, total, jnp.nan)

    running, finished = jax.lax.scan(step, running, (transitions.reward.T, transitions.done.T, transitions.valid.T))
    return running, finished.T
