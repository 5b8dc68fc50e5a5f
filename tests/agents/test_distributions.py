"""The squashed normal: a density, differentiable through its samples, finite for saturated actions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.agents.distributions import TanhNormal


def draws(mean, log_std, num, seed=0):
    """Actions and log densities of a one-dimensional distribution."""
    distribution = TanhNormal(mean=jnp.array([mean]), log_std=jnp.array([log_std]))
    actions, log_prob = jax.vmap(distribution.sample_and_log_prob)(jax.random.split(jax.random.key(seed), num))
    return np.asarray(actions[:, 0]), np.asarray(log_prob)


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, -1.0), (0.7, -0.3), (-0.4, 0.0)])
def test_density_integrates_to_one(x64, mean, log_std):
    actions, log_prob = draws(mean, log_std, 20_000)
    order = np.argsort(actions)
    np.testing.assert_allclose(np.trapezoid(np.exp(log_prob[order]), actions[order]), 1.0, atol=2e-3)


def test_density_is_that_of_the_change_of_variables(x64):
    distribution = TanhNormal(mean=jnp.array([0.3, -0.8]), log_std=jnp.array([-0.5, 0.2]))
    actions, log_prob = jax.vmap(distribution.sample_and_log_prob)(jax.random.split(jax.random.key(1), 100))
    actions, raw, std = np.asarray(actions), np.arctanh(actions), np.exp([-0.5, 0.2])
    normal = -0.5 * ((raw - [0.3, -0.8]) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(log_prob, (normal - np.log(1 - actions**2)).sum(1), rtol=1e-9, atol=1e-9)


def test_samples_have_the_stated_mean_and_deviation():
    raw = np.arctanh(draws(0.3, -0.7, 4000)[0].astype(np.float64))
    np.testing.assert_allclose([raw.mean(), raw.std()], [0.3, np.exp(-0.7)], atol=0.03)


@pytest.mark.parametrize("mean", [20.0, -20.0])
def test_saturated_actions_have_exact_finite_densities_and_slopes(mean):
    key, zero = jax.random.key(2), jnp.zeros(1)
    raw0 = np.arctanh(np.float64(TanhNormal(mean=zero, log_std=zero).sample(key)[0]))  # the same noise around 0
    raw = mean + raw0

    def log_prob(mean):
        return TanhNormal(mean=mean, log_std=zero).sample_and_log_prob(key)[1]

    log_det = np.log(4.0) - 2 * abs(raw) - 2 * np.log1p(np.exp(-2 * abs(raw)))
    expected = -0.5 * raw0**2 - 0.5 * np.log(2 * np.pi) - log_det
    got, slope = jax.value_and_grad(log_prob)(jnp.array([mean]))
    np.testing.assert_allclose(got, expected, rtol=1e-5)
    np.testing.assert_allclose(slope, [2.0 * np.sign(mean)], rtol=1e-6)  # -d log(1 - tanh^2) = 2 tanh


def test_gradient_flows_through_the_sample(x64):
    key = jax.random.key(3)
    x = {"mean": jnp.array([0.3, -0.5]), "log_std": jnp.array([-0.4, 0.3])}
    dx = {"mean": jnp.array([1.0, -2.0]), "log_std": jnp.array([0.5, 1.5])}

    def f(x):
        action, log_prob = TanhNormal(**x).sample_and_log_prob(key)
        return jnp.array([action[0], action[1], log_prob])

    got = jax.jvp(f, (x,), (dx,))[1]
    ahead, behind = (f(jax.tree.map(lambda a, d: a + s * d, x, dx)) for s in (1e-6, -1e-6))
    np.testing.assert_allclose(got, (ahead - behind) / 2e-6, rtol=1e-7, atol=1e-8)
    assert (np.abs(got) > 1e-3).all()


def test_mode_is_the_median():
    mean = jnp.array([0.6])
    mode = TanhNormal(mean=mean, log_std=jnp.zeros(1)).mode()
    np.testing.assert_allclose(mode, np.tanh(0.6), rtol=1e-6)
    assert abs(np.mean(draws(0.6, 0.0, 4000)[0] < np.asarray(mode)[0]) - 0.5) < 0.03
