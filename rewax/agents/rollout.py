"""A policy acting in one environment, differentiably."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax

from rewax.envs.base import Env, State
from rewax.status import FATAL
from rewax.types import Array, Key, Observation

Differentiation = Literal["full", "checkpointed", "none"]
"""How a rollout is differentiated: store everything, recompute each step from its state, or not at all."""


class Transition(NamedTuple):
    """One step; from a rollout with a leading axis of time."""

    obs: Observation
    action: Array
    reward: Array
    next_obs: Observation
    """After the step, before any reset."""
    terminated: Array
    truncated: Array
    status: Array
    failed_leaf: Array
    """See ``State.failed_leaf``."""
    metrics: dict[str, Array]
    extras: dict[str, Array]
    """What the policy said beside its action, e.g. its entropy."""

    @property
    def done(self) -> Array:
        """The episode ended, one way or the other."""
        return self.terminated | self.truncated

    @property
    def valid(self) -> Array:
        """The step did not fail numerically. Of a failed one nothing counts: it has no reward and no next value."""
        return (self.status & int(FATAL)) == 0


Policy = Callable[[Observation, Key], tuple[Array, dict[str, Array]]]


def rollout(
    env: Env, state: State, policy: Policy, key: Key, *, horizon: int, differentiate: Differentiation = "checkpointed"
) -> tuple[State, Transition]:
    """Act for ``horizon`` steps in one environment behind ``AutoReset``.

    Args:
      env: an environment whose states carry ``final_obs``.
      state: where to start; no gradient is taken through it unless the caller does.
      policy: ``(obs, key) -> (action, extras)``.
      key: randomness of the policy.
      horizon: number of steps.
      differentiate: ``"full"`` stores every intermediate value of every step, ``"checkpointed"`` stores states and
        recomputes each step in the backward pass, ``"none"`` cuts all gradients.

    Returns:
      Final state, and transitions with leading axis (horizon,). Gradient: through actions, physics, observations and
      rewards, cut at the end of each episode.
    """

    def step(state: State, key: Key) -> tuple[State, Transition]:
        action, extras = policy(state.obs, key)
        new = env.step(state, action)
        assert new.final_obs is not None, "rollout needs an environment behind AutoReset"
        transition = Transition(
            obs=state.obs,
            action=action,
            reward=new.reward,
            next_obs=new.final_obs,
            terminated=new.terminated,
            truncated=new.truncated,
            status=new.status,
            failed_leaf=new.failed_leaf,
            metrics=new.metrics,
            extras=extras,
        )
        return new, transition

    body = jax.checkpoint(step, prevent_cse=False) if differentiate == "checkpointed" else step
    out = jax.lax.scan(body, state, jax.random.split(key, horizon))
    return jax.lax.stop_gradient(out) if differentiate == "none" else out
