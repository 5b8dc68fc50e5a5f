"""The policy of an agent: legal actions, which depend on parameters, observation and key alone."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.agents.base import Agent, TrainState
from rewax.envs.base import Env
from rewax.envs.memory import action_of, stage
from rewax.testing.agent_states import compiled
from rewax.testing.functions import check_same
from rewax.testing.traced import traced_reset
from rewax.types import Array, Key, Observation

_NUM_OBSERVATIONS = 4


def check_policy(agent: Agent, env: Env, state: TrainState, key: Key, tolerance: float) -> None:
    """Actions keep the spec; ``deterministic`` ignores the key; ``vmap`` is a loop."""
    reset = traced_reset(stage(env, agent.policy))
    keys = jax.random.split(key, _NUM_OBSERVATIONS)
    observations = [reset(k).obs for k in keys]
    stacked = jax.tree.map(lambda *rows: jnp.stack(rows), *observations)
    for deterministic in (False, True):
        how = f"policy(..., deterministic={deterministic})"

        def policy(obs: Observation, key: Key, deterministic: bool = deterministic) -> Array:
            return action_of(agent.policy(state, obs, key, deterministic=deterministic))

        actions = [policy(obs, k) for obs, k in zip(observations, keys, strict=True)]
        for action in actions:
            _check_action(env, action, how)
        remedy = "let the action depend on state, observation and key alone"
        check_same(policy(observations[0], keys[0]), actions[0], 0.0, f"two calls of {how}", remedy, of="the action")
        batch = compiled(f"vmap({how})", jax.jit(jax.vmap(policy)), stacked, keys)
        what = f"vmap of {how}, and a loop over observations,"
        check_same(batch, jnp.stack(actions), tolerance, what, remedy, of="the action")
    again = action_of(agent.policy(state, observations[0], keys[1], deterministic=True))
    assert np.array_equal(again, actions[0]), (
        "policy(..., deterministic=True) gives different actions for different keys: return the mode or the mean"
    )


def _check_action(env: Env, action: Array, how: str) -> None:
    spec = env.action_spec
    assert jnp.shape(action) == spec.shape, (
        f"{how} returns shape {jnp.shape(action)}, action_spec has {spec.shape}: return the action of one environment"
    )
    assert jnp.issubdtype(action.dtype, jnp.floating), f"{how} returns dtype {action.dtype}: use a float"
    assert bool(jnp.all(jnp.isfinite(action))), f"{how} returns an action that is not finite: {np.asarray(action)}"
    inside = bool(jnp.all((action >= spec.low) & (action <= spec.high)))
    assert inside, (
        f"{how} returns an action beyond the bounds of its spec [{spec.low}, {spec.high}]: {np.asarray(action)}; "
        "squash it with tanh, or clip it"
    )
