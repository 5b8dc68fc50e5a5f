"""RPO: its first epoch follows SHAC's gradient; later epochs weight and mask samples."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_cases import CASES, ENV, agent

from rewax.agents import rpo, shac
from rewax.agents.actor_critic import make_actor_critic
from rewax.agents.gradients import mean_of_finite, per_env_gradients
from rewax.agents.rpo import RPOConfig

CONFIG = dataclasses.replace(CASES["rpo"].config, kl_coefficient=0.3, entropy_coefficient=0.0)
NETWORKS = make_actor_critic(ENV, CONFIG)
KEY = jax.random.key(3)


@pytest.fixture(scope="module")
def start():
    return agent("rpo").init(jax.random.key(0))


@pytest.fixture(scope="module")
def rolled(start):
    """Losses, rollouts, and derivatives with respect to actions."""

    @jax.jit
    def roll(state):
        loss = functools.partial(rpo.shifted_loss, networks=NETWORKS)
        return per_env_gradients(loss, jnp.zeros((CONFIG.horizon, 1)), state.common(), state.environments, KEY)

    return roll(start)


def slope(params, start, rolled, config=CONFIG, counts=None):
    _, rollouts, by_action = rolled
    networks = dataclasses.replace(NETWORKS, config=config)
    loss = functools.partial(
        rpo.surrogate_loss,
        networks=networks,
        obs=networks.normalize(start.environments.statistics, rollouts.transitions.obs),
        aux=rollouts.transitions.aux,
        by_action=by_action,
        counts=jnp.ones(by_action.shape[:2], bool) if counts is None else counts,
    )
    return jax.jit(jax.value_and_grad(loss, has_aux=True))(params)


def test_the_first_epoch_follows_the_gradient_of_shac(start, rolled):
    loss = functools.partial(shac.actor_loss, networks=NETWORKS)
    losses, _, grads = jax.jit(lambda p: per_env_gradients(loss, p, start.common(), start.environments, KEY))(
        start.actor_params
    )
    expected, _ = mean_of_finite(losses, grads)
    (_, metrics), found = slope(start.actor_params, start, rolled)
    assert metrics["kept"] == 1.0 and abs(metrics["kl"]) < 1e-6
    chex.assert_trees_all_close(
        found, expected, rtol=2e-3, atol=2e-5
    )  # noise is a difference over a standard deviation


def test_samples_with_a_ratio_outside_its_range_are_masked(start, rolled):
    far = jax.tree.map(lambda a: a + 0.3, start.actor_params)
    (_, metrics), _ = slope(far, start, rolled)
    assert 0.0 < metrics["kept"] < 1.0 and metrics["kl"] > 0.01
    acted = {name: np.asarray(value, np.float64) for name, value in rolled[1].transitions.aux.items()}
    obs = NETWORKS.normalize(start.environments.statistics, rolled[1].transitions.obs)
    now = jax.vmap(jax.vmap(lambda one: NETWORKS.distribution(far, one)))(obs)

    def log_density(mean, log_std):
        return (-0.5 * ((acted["raw"] - mean) / np.exp(log_std)) ** 2 - log_std).sum(-1)

    ratio = np.exp(log_density(now.mean, now.log_std) - log_density(acted["mean"], acted["log_std"]))
    along = (np.asarray(rolled[2]) * acted["raw"]).sum(-1)  # reparameterised actions equal the taken ones
    for low, high in ((0.0, float(np.median(ratio)) + 1.0), (min(float(np.median(ratio)), 0.99), 1e9)):
        counts = (ratio >= low) & (ratio <= high)
        assert 0 < counts.sum() < counts.size
        config = dataclasses.replace(CONFIG, lowest_ratio=low, highest_ratio=high, kl_coefficient=0.0)
        (value, metrics), _ = slope(far, start, rolled, config)
        np.testing.assert_allclose(metrics["kept"], counts.mean(), rtol=1e-6)
        np.testing.assert_allclose(value, np.sum(ratio * along * counts) / len(ratio), rtol=2e-3, atol=1e-5)


def test_an_environment_that_failed_has_no_part(start, rolled):
    losses, data, by_action = rolled
    broken = (losses, data, by_action.at[1].set(jnp.nan))
    counts = jnp.ones(by_action.shape[:2], bool).at[1].set(False)
    _, found = slope(start.actor_params, start, broken, counts=counts)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))


def test_where_every_environment_failed_metrics_are_numbers_and_nothing_is_learnt(start, rolled):
    _, rollouts, by_action = rolled
    none = jnp.zeros(CONFIG.num_envs, bool)
    new, metrics = rpo.actor_epochs(NETWORKS, start, rollouts, by_action, none)
    assert all(float(metrics[name]) == 0.0 for name in ("kl", "entropy", "kept", "actor_grad_norm"))
    chex.assert_trees_all_close(new.actor_params, start.actor_params, rtol=1e-3)


def test_the_range_holds_one():
    with pytest.raises(
        ValueError, match=r"lowest_ratio is 1\.5 and highest_ratio 2\.0: give numbers below and above 1"
    ):
        RPOConfig(lowest_ratio=1.5)
