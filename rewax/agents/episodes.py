"""What a rollout says of its episodes, as metrics."""

import jax.numpy as jnp

from rewax.agents.base import Metrics
from rewax.agents.environments import Environments, running_returns
from rewax.agents.rollout import Transition
from rewax.envs.base import NO_LEAF
from rewax.status import Status


def episode_metrics(environments: Environments, transitions: Transition) -> Metrics:
    """Metrics that every algorithm reports.

    Args:
      environments: before the rollout.
      transitions: leading axes (num_envs, horizon).

    Returns:
      ``return``: mean over the episodes that ended without failure, NaN if none did; ``reward``: mean over steps;
      ``episodes``, ``failed_episodes``: that ended, and of these by a numerical failure; ``status/<BIT>``: steps with
      that bit of ``Status``; ``failed_env``, ``failed_leaf``: the first environment that failed, and which of its
      arrays (see ``rewax.envs.base.failed_leaf_name``), -1 if none did; ``env/<name>``: means of the environment's own.
    """
    _, finished = running_returns(environments.episode_return, transitions)
    counted = jnp.isfinite(finished)
    failed = transitions.failed
    # Reductions alone, no index: where environments are divided over devices none of them has to be sent.
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
