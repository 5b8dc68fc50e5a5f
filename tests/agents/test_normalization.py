"""Running statistics: in parts = at once = numpy, and what normalisation leaves alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.agents.normalization import EPSILON, init_statistics, normalize, update_statistics
from rewax.envs.base import ArraySpec

SPEC = {"points": ArraySpec((5, 3)), "q": ArraySpec((4,)), "height": ArraySpec(())}


def observations(num):
    rng = np.random.default_rng(0)
    return {
        "points": jnp.asarray(rng.normal(size=(num, 5, 3))),
        "q": jnp.asarray(rng.normal([1.0, -30.0, 0.0, 5.0], [0.1, 3.0, 10.0, 0.0], (num, 4))),
        "height": jnp.asarray(rng.normal(2.0, 0.5, num)),
    }


def part(obs, first, last):
    return jax.tree.map(lambda a: a[first:last], obs)


def test_incremental_equals_at_once_equals_numpy(x64):
    obs, statistics = observations(60), init_statistics(SPEC)
    parts = statistics
    for first, last in [(0, 1), (1, 8), (8, 60)]:
        parts = update_statistics(parts, part(obs, first, last))
    once = update_statistics(statistics, obs)
    folded = update_statistics(statistics, jax.tree.map(lambda a: a.reshape(6, 10, *a.shape[1:]), obs))
    assert set(once.mean) == {"q", "height"}
    for name in once.mean:
        # The prior counts as one sample of mean 0 and variance 1.
        samples, weight = np.asarray(obs[name]), 61.0
        mean = samples.sum(0) / weight
        variance = (1.0 + (samples**2).sum(0)) / weight - mean**2
        for got in (once, parts, folded):
            assert got.count == weight
            np.testing.assert_allclose(got.mean[name], mean, rtol=1e-12, atol=1e-13)
            np.testing.assert_allclose(got.variance[name], variance, rtol=1e-10)


def test_prior_changes_nothing():
    obs = part(observations(1), 0, 1)
    got = normalize(init_statistics(SPEC), obs)
    np.testing.assert_allclose(got["q"], obs["q"] / np.sqrt(1.0 + EPSILON), rtol=1e-6)


def test_normalised_vectors_are_standard_and_point_clouds_untouched():
    obs = observations(4000)
    statistics = update_statistics(init_statistics(SPEC), obs)
    got = jax.vmap(lambda o: normalize(statistics, o))(obs)
    np.testing.assert_allclose(got["q"][:, :3].mean(0), 0.0, atol=0.05)
    np.testing.assert_allclose(got["q"][:, :3].std(0), 1.0, atol=0.05)
    np.testing.assert_array_equal(got["points"], obs["points"])


def test_gradient_reaches_observations_only():
    obs = part(observations(20), 0, 20)
    statistics = update_statistics(init_statistics(SPEC), obs)
    one = jax.tree.map(lambda a: a[0], obs)

    def total(statistics, obs):
        return sum(jnp.sum(a) for a in normalize(statistics, obs).values())

    by_statistics, by_obs = jax.grad(total, argnums=(0, 1))(statistics, one)
    assert all((np.asarray(leaf) == 0.0).all() for leaf in jax.tree.leaves(by_statistics))
    np.testing.assert_allclose(by_obs["q"], 1 / np.sqrt(np.asarray(statistics.variance["q"]) + EPSILON), rtol=1e-5)
    np.testing.assert_array_equal(by_obs["points"], np.ones((5, 3)))


@pytest.mark.parametrize("name", ["q", "height"])
def test_no_gradient_into_the_statistics(name):
    def mean(a):
        statistics = update_statistics(init_statistics({name: SPEC[name]}), {name: a})
        return jnp.sum(statistics.mean[name]) + jnp.sum(statistics.variance[name])

    assert (np.asarray(jax.grad(mean)(observations(3)[name])) == 0.0).all()
