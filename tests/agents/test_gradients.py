"""Gradients of many environments: finite ones are averaged, long ones clipped, and none affects another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rewax.agents.gradients import clip_per_env, mean_of_finite

GRADS = {"a": jnp.array([[3.0, 0.0], [0.0, 0.3], [jnp.nan, 1.0]]), "b": jnp.array([4.0, 0.4, 2.0])}


def test_the_mean_leaves_out_what_is_not_finite():
    losses = jnp.array([1.0, 2.0, 3.0])
    mean, kept = mean_of_finite(losses, GRADS)
    np.testing.assert_array_equal(kept, [True, True, False])
    np.testing.assert_allclose(mean["a"], [1.5, 0.15])
    np.testing.assert_allclose(mean["b"], 2.2)
    mean, kept = mean_of_finite(losses.at[0].set(jnp.inf), GRADS)  # a loss counts too
    np.testing.assert_array_equal(kept, [False, True, False])
    np.testing.assert_allclose(mean["b"], 0.4, rtol=1e-6)


def test_a_gradient_whose_norm_overflows_is_left_out():
    """Adam divides by its square, and clipping by its norm: both would stop every environment."""
    long = {"a": GRADS["a"].at[0, 0].set(1e20), "b": GRADS["b"]}
    mean, kept = mean_of_finite(jnp.zeros(3), long)
    np.testing.assert_array_equal(kept, [False, True, False])
    np.testing.assert_allclose(mean["a"], [0.0, 0.3])


def test_nothing_is_the_mean_of_nothing():
    mean, kept = mean_of_finite(jnp.full(3, jnp.nan), GRADS)
    assert not kept.any() and all((leaf == 0).all() for leaf in jax.tree.leaves(mean))


def test_each_environment_is_clipped_by_its_own_norm():
    clipped = clip_per_env(GRADS, 1.0)
    np.testing.assert_allclose(clipped["a"][:2], [[0.6, 0.0], [0.0, 0.3]], rtol=1e-6)
    np.testing.assert_allclose(clipped["b"][:2], [0.8, 0.4], rtol=1e-6)
    assert not np.isfinite(clipped["a"][2]).all()
    huge = clip_per_env({"a": jnp.array([[1e25, 1e25], [1.0, 0.0]])}, 1.0)  # finite, but its norm is not
    np.testing.assert_array_equal(mean_of_finite(jnp.zeros(2), huge)[1], [False, True])
    mean, kept = mean_of_finite(jnp.zeros(3), clipped)
    np.testing.assert_array_equal(kept, [True, True, False])
    np.testing.assert_allclose(mean["b"], 0.6, rtol=1e-6)


def test_the_median_leaves_out_environments_that_feel_nothing_or_failed():
    """Norms 1, 3, 8 count; more than half of the environments must not make the limit zero."""
    grads = jnp.array([[1.0, 0.0], [0.0, 3.0], [8.0, 0.0], *[[0.0, 0.0]] * 4, [jnp.nan, 1.0], [1e30, 1e30]])
    clipped = np.asarray(clip_per_env(grads, "median"))
    np.testing.assert_allclose(clipped[:7], [[1.0, 0.0], [0.0, 3.0], [3.0, 0.0], *[[0.0, 0.0]] * 4], rtol=1e-6)
    kept = mean_of_finite(jnp.zeros(9), clipped)[1]
    np.testing.assert_array_equal(kept, [True] * 7 + [False] * 2)
    np.testing.assert_array_equal(clip_per_env(jnp.zeros((3, 2)), "median"), np.zeros((3, 2)))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_direction_at_the_median_has_no_unit(scale):
    grads = jnp.asarray(np.random.default_rng(0).normal(size=(9, 5)) * 10.0 ** np.arange(-4, 5)[:, None], jnp.float32)
    mean = np.asarray(mean_of_finite(jnp.zeros(9), clip_per_env(scale * grads, "median"))[0])
    np.testing.assert_allclose(mean / scale, mean_of_finite(jnp.zeros(9), clip_per_env(grads, "median"))[0], rtol=1e-5)


@given(st.lists(st.floats(-1e6, 1e6, width=32), min_size=3, max_size=3), st.floats(0.125, 100.0, width=32))
def test_a_clipped_gradient_points_the_same_way_and_is_short_enough(values, max_norm):
    grads = jnp.array([values], jnp.float32)
    clipped = np.asarray(clip_per_env(grads, max_norm), np.float64)[0]
    assert np.linalg.norm(clipped) <= max_norm * (1 + 1e-5)
    if np.linalg.norm(values) <= max_norm * (1 - 1e-5):
        np.testing.assert_array_equal(clipped, np.float32(values))
    assert np.all(np.abs(np.cross(clipped, values)) <= 1e-5 * max(1.0, np.linalg.norm(values)) * max_norm)
