"""APG: its gradient is that of the rewards; with whole episodes, every iteration restarts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_cases import CASES, ENV, agent

from rewax.agents.actor_critic import make_actor
from rewax.agents.apg import APGConfig, make_apg

CALM = dataclasses.replace(CASES["apg_full"].config, log_std_range=(-20.0, -20.0), optimizer="adam")


def test_the_gradient_is_that_of_the_discounted_rewards_of_whole_episodes():
    calm = make_apg(ENV, CALM)
    start = calm.init(jax.random.key(0))
    _, metrics = calm.train_step(start)
    actor = make_actor(ENV, CALM)
    reset = jax.random.split(start.key, 3)[2]
    first = jax.jit(start.environments.restarted)(reset).state.obs["x"]

    def cost(params, x):
        total = 0.0
        for t in range(5):
            action = actor.action_distribution(params, start.environments.statistics, {"x": x}).mode()
            x = x + 0.5 * action
            total = total + 0.99**t * x[0] ** 2
        return total / 5

    loss = lambda params: jax.vmap(cost, (None, 0))(params, first).mean()  # noqa: E731
    value, grad = jax.jit(jax.value_and_grad(loss))(start.actor_params)
    np.testing.assert_allclose(metrics["actor_loss"], value, rtol=1e-4)
    norm = np.sqrt(sum(np.sum(np.square(leaf)) for leaf in jax.tree.leaves(grad)))
    np.testing.assert_allclose(metrics["actor_grad_norm"], norm, rtol=1e-3)


def test_whole_episodes_start_and_end_with_the_iteration():
    state = agent("apg_full").init(jax.random.key(0))
    for _ in range(2):
        state, metrics = agent("apg_full").train_step(state)
        assert int(metrics["episodes"]) == 4 and np.isfinite(metrics["return"])
    short, _ = agent("apg").train_step(agent("apg").init(jax.random.key(0)))
    assert jnp.any(short.environments.state.step_count != 0)  # goes on where it was


def test_a_horizon_of_zero_is_for_algorithms_with_whole_episodes():
    assert APGConfig(horizon=0).horizon == 0
    with pytest.raises(ValueError, match="horizon is 0: give an integer of at least 1"):
        dataclasses.replace(CASES["shac"].config, horizon=0)
