"""Regression: sums over chunks, masks, and the number of points per chunk."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from rewax.agents.value_fitting import chunk_size, fit_values, mean_over_chunks
from rewax.envs.base import ArraySpec

RNG = np.random.default_rng(0)
OBS = {"x": jnp.asarray(RNG.normal(size=(4, 8, 3)), jnp.float32)}
TARGETS = jnp.asarray(RNG.normal(size=(4, 8)), jnp.float32)
PARAMS = jnp.asarray(RNG.normal(size=(3, 2)), jnp.float32)
ALL = jnp.ones((4, 8), bool)


def values(params, obs):
    return obs["x"] @ params


def fit(obs=OBS, targets=TARGETS, valid=ALL, **changes):
    settings = {"passes": 3, "minibatches": 2, "chunk": 16} | changes
    optimizer = optax.sgd(0.05)
    return fit_values(values, PARAMS, optimizer.init(PARAMS), optimizer, obs, targets, valid, **settings)


def test_it_is_gradient_descent_on_contiguous_minibatches_in_order_of_time():
    params = np.asarray(PARAMS, np.float64)
    x, y = np.swapaxes(OBS["x"], 0, 1).reshape(2, 16, 3), np.swapaxes(TARGETS, 0, 1).reshape(2, 16)
    for _ in range(3):
        losses = []
        for obs, target in zip(x, y, strict=True):
            error = obs @ params - target[:, None]
            losses.append(np.mean(error**2))
            params = params - 0.05 * 2 * obs.T @ error / error.size
    new, _, metrics = fit()
    np.testing.assert_allclose(new, params, rtol=1e-4)
    np.testing.assert_allclose(metrics["critic_loss"], np.mean(losses), rtol=1e-4)


def test_minibatches_of_environments_hold_all_steps_of_every_nth_environment():
    got = fit(divide="environments", passes=1)
    params, optimizer = PARAMS, optax.sgd(0.05)
    for envs in (np.array([0, 2]), np.array([1, 3])):
        one = {"x": OBS["x"][envs]}
        params, *_ = fit_values(
            values,
            params,
            optimizer.init(params),
            optimizer,
            one,
            TARGETS[envs],
            ALL[envs],
            passes=1,
            minibatches=1,
            chunk=16,
        )
    np.testing.assert_allclose(got[0], params, rtol=1e-5)


def test_minibatches_of_environments_share_steps_that_are_cut_off():
    late = ALL.at[:, 3:].set(False)  # beyond an adaptive horizon
    expected = fit({"x": OBS["x"][:, :3]}, TARGETS[:, :3], ALL[:, :3], divide="environments", chunk=6)
    chex.assert_trees_all_close(fit(valid=late, divide="environments"), expected, rtol=1e-5)


@pytest.mark.parametrize("chunk", [1, 4])
def test_chunks_of_a_minibatch_add_up_to_its_update(chunk):
    chex.assert_trees_all_close(fit(chunk=chunk), fit(), rtol=1e-5)


def test_masked_samples_change_nothing():
    valid = ALL.at[1].set(False)
    spoilt = {"x": OBS["x"].at[1].set(jnp.nan)}
    got = fit(spoilt, TARGETS.at[1].set(jnp.nan), valid, minibatches=1, chunk=32)
    rest = np.array([0, 2, 3])
    expected = fit({"x": OBS["x"][rest]}, TARGETS[rest], ALL[rest], minibatches=1, chunk=24)
    chex.assert_trees_all_close(got, expected, rtol=1e-5)


def test_the_loss_is_an_argument():
    def absolute(values, targets):
        return jnp.abs(values - targets)

    params, _, metrics = fit(loss=absolute, passes=1, minibatches=1, chunk=32)
    x, y = np.asarray(OBS["x"], np.float64).reshape(32, 3), np.asarray(TARGETS).reshape(32)
    error = x @ np.asarray(PARAMS) - y[:, None]
    np.testing.assert_allclose(metrics["critic_loss"], np.abs(error).mean(), rtol=1e-5)
    np.testing.assert_allclose(params, PARAMS - 0.05 * x.T @ np.sign(error) / error.size, rtol=1e-4)


def test_nothing_is_learnt_from_no_samples():
    params, _, metrics = fit(valid=~ALL)
    np.testing.assert_array_equal(params, PARAMS)
    assert metrics["critic_loss"] == 0.0


def test_a_gradient_that_is_not_finite_changes_nothing():
    params, _, metrics = fit(targets=TARGETS.at[0, 0].set(jnp.inf), minibatches=1, chunk=32)
    np.testing.assert_array_equal(params, PARAMS)
    assert not np.isfinite(metrics["critic_loss"])  # and it is seen


def test_mean_over_chunks_is_a_mean():
    chunks = (jnp.arange(6.0).reshape(3, 2),)
    np.testing.assert_allclose(mean_over_chunks(lambda a: a.sum(), chunks), 5.0)
    np.testing.assert_allclose(mean_over_chunks(lambda a: a.sum(), (chunks[0][:1],)), 1.0)


@pytest.mark.parametrize(("num_points", "chunk"), [(2048, 2), (250, 16), (10, 256), (5000, 1)])
def test_point_clouds_are_differentiated_as_many_at_a_time_as_fit_the_cache(num_points, chunk):
    assert jax.default_backend() == "cpu"
    assert chunk_size(256, {"points": ArraySpec((num_points, 3)), "x": ArraySpec((7,))}) == chunk
