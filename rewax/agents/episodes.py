"""Metrics of the episodes in a rollout."""

import jax
import jax.numpy as jnp

from rewax.agents.base import Metrics
from rewax.agents.rollout import Transition
from rewax.envs.base import NO_LEAF
from rewax.status import Status
from rewax.types import Array


def episode_metrics(running: Array, transitions: Transition) -> Metrics:
    """Metrics that every algorithm reports.

    Args:
      running: returns, so far, of the episodes that the rollout continues (``running_returns``), shape (num_envs,).
      transitions: leading axes (num_envs, horizon).

    Returns:
      ``return``: mean over the episodes that ended without failure, NaN if none did. ``reward``: mean over steps.
      ``episodes``: number of episodes that ended. ``failed_episodes``: number that ended by a numerical failure.
      ``status/<BIT>``: number of steps with that bit of ``Status``. ``failed_env``: index of the first environment that
      failed, -1 if none did. ``failed_leaf``: index of the array that was not finite there, for
      ``rewax.envs.base.failed_leaf_name``. ``env/<name>``: means of the environment's own metrics over steps
      that did not fail.
    """
    _, finished = running_returns(running, transitions)
    counted = jnp.isfinite(finished)
    failed = transitions.failed
    # Reductions instead of indexing, so that sharded environments stay on their devices.
    index = jnp.arange(failed.size, dtype=jnp.int32).reshape(failed.shape)
    first = jnp.min(jnp.where(failed, index, failed.size))
    env, leaf = first // failed.shape[1], jnp.max(jnp.where(index == first, transitions.failed_leaf, NO_LEAF))
    bits = {
        f"status/{bit.name}": jnp.sum((transitions.status & int(bit)) != 0) for bit in Status if bit is not Status.OK
    }
    return {
        "return": jnp.where(counted.any(), jnp.nanmean(finished), jnp.nan),
        "reward": transitions.reward.mean(where=transitions.active),
        "episodes": jnp.sum(transitions.done),
        "failed_episodes": jnp.sum(failed),
        **bits,
        "failed_env": jnp.where(failed.any(), env, NO_LEAF),
        "failed_leaf": jnp.where(failed.any(), leaf, NO_LEAF),
        **{f"env/{name}": value.mean(where=transitions.valid) for name, value in transitions.metrics.items()},
    }


def running_returns(running: Array, transitions: Transition) -> tuple[Array, Array]:
    """Returns of running and of finished episodes.

    Args:
      running: returns so far of the running episodes, shape (num_envs,). NaN marks an unknown return, until the episode
        ends.
      transitions: leading axes (num_envs, horizon).

    Returns:
      Returns so far after the rollout, shape (num_envs,). Returns of the episodes that ended, at the step that ended
      them, shape (num_envs, horizon); NaN at other steps and for episodes that failed numerically.
    """

    def step(carry: Array, inputs: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        reward, done, valid = inputs
        total = carry + reward
        return jnp.where(done, 0.0, total), jnp.where(done & valid, total, jnp.nan)

    running, finished = jax.lax.scan(step, running, (transitions.reward.T, transitions.done.T, transitions.valid.T))
    return running, finished.T
