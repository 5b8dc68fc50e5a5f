"""AGPO: share 1 gives the simulation's gradient, share 0 the critics' gradient after one step."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_cases import CASES, ENV

from rewax.agents import agpo, sapo
from rewax.agents.actor_critic import make_actor_critic
from rewax.agents.registry import make_agent
from rewax.envs.wrappers import AutoReset

CONFIG = CASES["sapo_agpo"].config
STATE = make_agent("sapo_agpo", ENV, CONFIG).init(jax.random.key(0))
ONE = jax.tree.map(lambda a: a[0], STATE.environments.state).replace(step_count=jnp.int32(0))
KEY = jax.random.key(1)


def test_shares_by_hand():
    config = dataclasses.replace(CONFIG, discount=0.5, max_ratio=2.0)
    shares = agpo.simulation_shares(config, jnp.array([8.0, 1.0, 0.0, 1.0]) * 0.25 ** jnp.arange(4))
    np.testing.assert_allclose(shares, [0.25, 1.0, 1.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(agpo.simulation_shares(config, jnp.zeros(4)), 1.0)


def test_a_latency_does_not_take_the_share_of_the_simulation():
    """The last action has no effect within the rollout, so the step before it tells the variance of the critics."""
    config = dataclasses.replace(CONFIG, discount=1.0, max_ratio=2.0)
    shares = agpo.simulation_shares(config, jnp.array([8.0, 1.0, 1.0, 0.0]))
    np.testing.assert_allclose(shares, [0.25, 1.0, 1.0, 1.0], rtol=1e-6)


def test_the_critics_part_leaves_out_the_ends_of_segments():
    done, valid = jnp.array([False, True, False, False]), jnp.ones(4, bool)
    share = jnp.array([1.0, 1.0, 0.5, 1.0])
    part = agpo.critic_part(jnp.array([2.0, 3.0, 5.0, 7.0]), share, done, valid, discount=0.5)
    assert float(part) == 0.5 * 2.0 + 0.5 * 0.5 * 5.0


def loss_gradient(variance, max_ratio=2.0):
    """Gradient of one environment's loss with respect to the actor's parameters and the actions, and its rollouts."""
    networks = make_actor_critic(ENV, dataclasses.replace(CONFIG, max_ratio=max_ratio))
    state = STATE.replace(variance=variance)
    loss = loss_of(networks, state)
    both = (STATE.actor_params, jnp.zeros((CONFIG.horizon, 1)))
    return networks, jax.jit(jax.grad(loss, has_aux=True))(both)


def loss_of(networks, state):
    return lambda p: agpo.actor_loss(p, state.common(), AutoReset(env=ENV), ONE, KEY, networks=networks)


def test_with_the_share_one_it_is_sapo():
    networks, ((actor, _), _) = loss_gradient(jnp.ones(4), 1e6)
    loss = lambda p: sapo.actor_loss(p, STATE.common(), AutoReset(env=ENV), ONE, KEY, networks=networks)[0]  # noqa: E731
    plain = jax.jit(jax.grad(loss))(STATE.actor_params)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), actor, plain)


def test_without_the_simulation_each_action_sees_its_reward_and_the_value_after_it():
    """d/da of discount^t (r + discount V(x + a / 2)), r = -(x + a / 2)^2, by hand."""
    networks, ((_, actions), rollouts) = loss_gradient(jnp.ones(4), 1e-12)
    statistics = STATE.environments.statistics

    def value(x):
        obs = networks.normalize(statistics, {"x": x[None]})
        return networks.values(STATE.critic_params, obs).mean()

    after = rollouts.transitions.next_obs["x"]
    slope = jax.jit(jax.vmap(jax.grad(value)))(after)
    expected = -(0.99 ** np.arange(4))[:, None] * 0.5 * (-2.0 * after + 0.99 * slope) / 4
    np.testing.assert_allclose(actions, expected, rtol=1e-4, atol=1e-6)


def test_the_shares_cut_the_state_alone():
    with pytest.raises(ValueError, match="truncate_every is 2"):
        dataclasses.replace(CONFIG, truncate_every=2)
