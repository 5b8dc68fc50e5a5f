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
      running: returns of the episodes under way before the rollout, see ``running_returns``.
      transitions: leading axes (num_envs, horizon).

    Returns:
      ``return``: mean over the episodes that ended without failure, NaN if none did; ``reward``: mean over steps;
      ``episodes``, ``failed_episodes``: that ended, and of these by a numerical failure; ``status/<BIT>``: steps with
      that bit of ``Status``; ``failed_env``, ``failed_leaf``: the first environment that failed, and which of its
      arrays (see ``rewax.envs.base.failed_leaf_name``), -1 if none did; ``env/<name>``: means of the environment's own.
    """
    _, finished = running_returns(running, transitions)
    counted = jnp.isfinite(finished)
    failed = transitions.failed
    # Reductions instead of an index: sharded environments then need not be sent to other devices.
    place = jnp.arange(failed.size, dtype=jnp.int32).reshape(failed.shape)
    first = jnp.min(jnp.where(failed, place, failed.size))
    env, leaf = first // failed.shape[1], jnp.max(jnp.where(place == first, transitions.failed_leaf, NO_LEAF))
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
        **{f"env/{name}": value.mean(where=transitions.active) for name, value in transitions.metrics.items()},
    }


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
