"""Smooth rewards: values by hand, slopes that are finite and where they should be, reverse = forward = difference."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.envs.kit import rewards


def test_values_are_the_formulas():
    np.testing.assert_allclose(rewards.smooth_norm(jnp.array([[3.0, 4.0], [0.0, 0.0]]), 0.1), [25.01**0.5 - 0.1, 0.0])
    np.testing.assert_allclose(rewards.near(jnp.array([0.0, 0.2, 0.8]), 0.2), [1.0, 0.5, 1.0 / 17.0], rtol=1e-6)
    np.testing.assert_allclose(rewards.beyond(jnp.array(1.0), 1.0, 0.1), 0.1 * np.log(2.0), rtol=1e-6)
    np.testing.assert_allclose(rewards.beyond(jnp.array([-9.0, 3.0]), 1.0, 0.1), [0.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(rewards.share_beyond(jnp.array([-9.0, 1.0, 9.0]), 1.0, 0.1), [0.0, 0.5, 1.0], atol=1e-6)
    weights = np.exp([-1.0, -3.0])
    np.testing.assert_allclose(
        rewards.smooth_min(jnp.array([0.1, 0.3]), 0.1), weights @ [0.1, 0.3] / weights.sum(), rtol=1e-5
    )


def test_the_norm_has_a_slope_at_zero_and_far_away():
    slope = jax.grad(rewards.smooth_norm)
    np.testing.assert_array_equal(slope(jnp.zeros(3)), 0.0)
    np.testing.assert_allclose(slope(jnp.array([0.0, 2.0, 0.0]), 1e-3), [0.0, 1.0, 0.0], atol=1e-6)


def test_near_is_steepest_where_it_says():
    d = jnp.linspace(0.0, 1.0, 2001)
    slope = np.abs(np.asarray(jax.vmap(jax.grad(lambda d: rewards.near(d, 0.2)))(d)))
    assert float(d[slope.argmax()]) == pytest.approx(0.58 * 0.2, abs=1e-3)
    assert slope.max() / slope[np.searchsorted(np.asarray(d), 0.8)] == pytest.approx(23.5, rel=0.05)


@pytest.mark.parametrize(
    "piece",
    [
        lambda x: rewards.smooth_norm(x, 0.1),
        lambda x: rewards.near(x, 0.3).sum(),
        lambda x: rewards.beyond(x, 0.2, 0.1).sum(),
        lambda x: rewards.share_beyond(x, 0.2, 0.1).sum(),
        lambda x: rewards.smooth_min(x, 0.1),
    ],
)
def test_gradients_are_exact(piece, x64):
    x, h = jnp.array([0.31, -0.12, 0.05]), 1e-6
    slope, forward = jax.jit(lambda x: (jax.grad(piece)(x), jax.jacfwd(piece)(x)))(x)
    np.testing.assert_allclose(slope, forward, rtol=1e-12)
    differences = jax.jit(jax.vmap(lambda e: (piece(x + h * e) - piece(x - h * e)) / (2 * h)))(jnp.eye(3))
    np.testing.assert_allclose(slope, differences, rtol=1e-7, atol=1e-9)
