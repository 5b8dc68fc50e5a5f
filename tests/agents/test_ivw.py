"""Inverse-variance weights give the least variance, and scale each step's contribution to the gradient."""

import dataclasses
import functools

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from agent_cases import CASES, ENV, agent

from rewax.agents import agpo, ivw, sapo
from rewax.agents.actor_critic import make_actor_critic
from rewax.agents.agpo import AGPOConfig
from rewax.agents.registry import make_agent
from rewax.envs.wrappers import AutoReset

CONFIG = CASES["sapo_ivw"].config


def test_weights_are_those_of_least_variance():
    """Among weighted sums with the same expectation, if step t has mean discount^t and its own variance."""
    config = dataclasses.replace(CONFIG, discount=0.8, variance_floor=1e-6)
    variance, mean = np.array([9.0, 4.0, 1.0, 0.25]), 0.8 ** np.arange(4)
    weights = np.asarray(ivw.step_weights(config, jnp.array(variance, jnp.float32)))
    np.testing.assert_allclose(weights @ mean, mean.sum(), rtol=1e-6)
    least = mean.sum() ** 2 / np.sum(mean**2 / variance)  # Cauchy-Schwarz
    np.testing.assert_allclose(weights**2 @ variance, least, rtol=1e-5)
    assert variance.sum() > 2.5 * least  # equal weights


def test_equal_weights_at_first_and_where_nothing_varies():
    config = dataclasses.replace(CONFIG, discount=0.9, horizon=64)
    first = make_agent("sapo_ivw", ENV, config).init(jax.random.key(0)).variance
    np.testing.assert_allclose(ivw.step_weights(config, first), 1.0, rtol=1e-6)
    np.testing.assert_allclose(ivw.step_weights(CONFIG, jnp.zeros(CONFIG.horizon)), 1.0, rtol=1e-6)


def test_a_step_whose_variance_is_zero_counts_as_the_mean_of_the_others():
    config = dataclasses.replace(CONFIG, discount=1.0, variance_floor=0.5)
    weights = ivw.step_weights(config, jnp.array([0.0, 1.0, 0.2, 4.8]))  # mean 2, floor 1
    inverse = np.array([0.5, 1.0, 1.0, 1 / 4.8])
    np.testing.assert_allclose(weights, 4.0 * inverse / inverse.sum(), rtol=1e-6)


def test_the_variance_leaves_out_what_is_not_finite_and_what_the_actor_leaves_out():
    gradients = jnp.array(
        [[[1.0, 0.0], [0.0, 0.0]], [[3.0, 4.0], [0.0, 1.0]], [[jnp.nan, 1.0], [9.0, 9.0]], [[7.0, 7.0], [7.0, 7.0]]]
    )
    valid = jnp.array([True, True, True, False])
    np.testing.assert_allclose(ivw.step_variance(gradients, valid), [2.0 + 8.0, 0.5], rtol=1e-6)


def test_a_variance_that_overflows_counts_as_large():
    gradients = jnp.array([[3e38, 1.0, 0.0], [-3e38, 2.0, 1.0], [3e38, 4.0, 2.0]])[..., None]
    variance = ivw.step_variance(gradients, jnp.ones(3, bool))
    assert np.all(np.isfinite(variance)) and variance[0] > 1e15
    weights = ivw.step_weights(dataclasses.replace(CONFIG, horizon=3), variance)
    assert np.all(np.isfinite(weights)) and weights[0] < 0.5 * weights[1:].min()
    shares = agpo.simulation_shares(AGPOConfig(horizon=3), variance)
    assert shares[0] < 1e-10 and shares[2] == 1.0


def test_one_chaotic_iteration_is_forgotten_soon():
    state = make_agent("sapo_ivw", ENV, CONFIG).init(jax.random.key(0))
    ordinary = jnp.array([1.0, -1.0])[:, None, None] * jnp.ones((2, CONFIG.horizon, 1)) / jnp.sqrt(2.0)
    update = jax.jit(lambda state, g: ivw.running_variance(state, g, jnp.ones(2, bool), 0.9))
    for k, scale in enumerate([1.0, 1e5, *[1.0] * 10]):
        later = state.replace(iteration=jnp.int32(k))
        state = state.replace(
            variance=update(later, ordinary * jnp.array([scale, *[1.0] * (CONFIG.horizon - 1)])[:, None])
        )
    np.testing.assert_allclose(state.variance[1:], 1.0, rtol=1e-5)
    assert 1.0 < state.variance[0] < 1.5


def test_a_single_environment_has_no_variance():
    for config in (ivw.IVWConfig, AGPOConfig):
        with pytest.raises(ValueError, match=r"^num_envs is 1: give at least 2, because the variance"):
            config(num_envs=1)


@pytest.fixture(scope="module")
def gradient():
    """A function of the variances: the gradient of one environment's loss with respect to actor parameters and actions."""
    networks = make_actor_critic(ENV, CONFIG)
    state = agent("sapo_ivw").init(jax.random.key(0))
    one = jax.tree.map(lambda a: a[0], state.environments.state)
    params = (state.actor_params, jnp.zeros((CONFIG.horizon, 1)))

    @jax.jit
    def of(variance):
        loss = lambda p: ivw.actor_loss(  # noqa: E731
            p, state.replace(variance=variance).common(), AutoReset(env=ENV), one, jax.random.key(1), networks=networks
        )[0]
        return jax.grad(loss)(params)

    plain = lambda p: sapo.actor_loss(  # noqa: E731
        p, state.common(), AutoReset(env=ENV), one, jax.random.key(1), networks=networks
    )[0]
    return of, jax.jit(jax.grad(plain))(state.actor_params)


def test_with_equal_weights_it_is_sapo(gradient):
    of, plain = gradient
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), of(ivw.discounts(CONFIG))[0], plain
    )


def test_each_step_has_its_weight_and_actions_keep_their_gradient(gradient):
    """The gradient is linear in the weights: four sets of weights give the contributions of the four steps, and a fifth tests
    them."""
    of, _ = gradient
    variances = [jnp.array(v) for v in ([1.0, 2, 3, 4], [4.0, 1, 1, 2], [2.0, 5, 1, 1], [1.0, 1, 3, 1], [3.0, 2, 2, 1])]
    weights = np.array([ivw.step_weights(CONFIG, v) for v in variances], np.float64)
    flat = [jax.flatten_util.ravel_pytree(of(v)[0])[0] for v in variances]
    assert np.abs(flat[0] - flat[1]).max() > 0.1 * np.abs(flat[0]).max()
    shares = np.linalg.solve(weights[:4], np.array(flat[:4], np.float64))
    np.testing.assert_allclose(weights[4] @ shares, flat[4], rtol=1e-3, atol=1e-5)
    for v in variances[1:]:
        np.testing.assert_allclose(of(v)[1], of(variances[0])[1], rtol=1e-5, atol=1e-7)


def test_the_variance_is_that_of_clipped_gradients():
    """Each environment's gradient with respect to the actions is scaled like the one that the actor follows."""
    assert_the_first_environment_adds_no_variance(1e6, 1e6, max_env_grad_norm=0.5)


@pytest.mark.parametrize(("actor", "constant"), [(1.0, jnp.nan), (jnp.inf, 0.0)])
def test_the_variance_is_that_of_environments_that_the_actor_follows(actor, constant):
    """The gradients with respect to the actions are finite, but the loss or the actor's gradient is not."""
    assert_the_first_environment_adds_no_variance(actor, 1e6, constant)


def assert_the_first_environment_adds_no_variance(actor, actions, constant=0.0, **options):
    """Its gradient has these factors, with respect to the actor and to the actions; those of the others are 1."""
    networks = make_actor_critic(ENV, dataclasses.replace(CONFIG, **options))
    state = agent("sapo_ivw").init(jax.random.key(0))

    def loss(params, common, env, env_state, key, first):
        del common, env, key
        here = env_state.obs["x"][0] == first
        of_actor, of_actions, rest = (
            jnp.where(here, *pair) for pair in ((actor, 1.0), (actions, 1.0), (constant, 0.0))
        )
        total = sum(jnp.sum(a) for a in jax.tree.leaves(params[0]))
        return of_actions * jnp.sum(params[1]) + of_actor * total + rest, jnp.zeros(())

    loss = functools.partial(loss, first=float(state.environments.state.obs["x"][0, 0]))
    update = jax.jit(lambda state: ivw.measured_actor_update(networks, state, loss, jax.random.key(1), decay=0.9)[0])
    new = update(state)
    np.testing.assert_allclose(new.variance, 0.0, atol=1e-12)
