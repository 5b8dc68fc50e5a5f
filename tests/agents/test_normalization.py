"""Running statistics: incremental = at once = numpy; normalisation leaves point clouds unchanged."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.agents.normalization import (
    EPSILON,
    WINSOR_WIDTH,
    _order_statistics,
    init_statistics,
    normalize,
    update_statistics,
)
from rewax.envs.base import ArraySpec

update = jax.jit(update_statistics)
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
        parts = update(parts, part(obs, first, last))
    once = update(statistics, obs)
    folded = update(statistics, jax.tree.map(lambda a: a.reshape(6, 10, *a.shape[1:]), obs))
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
    statistics = update(init_statistics(SPEC), obs)
    got = jax.jit(jax.vmap(lambda o: normalize(statistics, o)))(obs)
    np.testing.assert_allclose(got["q"][:, :3].mean(0), 0.0, atol=0.05)
    np.testing.assert_allclose(got["q"][:, :3].std(0), 1.0, atol=0.05)
    np.testing.assert_array_equal(got["points"], obs["points"])


def test_gradient_reaches_observations_only():
    obs = part(observations(20), 0, 20)
    statistics = update(init_statistics(SPEC), obs)
    one = jax.tree.map(lambda a: a[0], obs)

    def total(statistics, obs):
        return sum(jnp.sum(a) for a in normalize(statistics, obs).values())

    by_statistics, by_obs = jax.jit(jax.grad(total, argnums=(0, 1)))(statistics, one)
    assert all((np.asarray(leaf) == 0.0).all() for leaf in jax.tree.leaves(by_statistics))
    np.testing.assert_allclose(by_obs["q"], 1 / np.sqrt(np.asarray(statistics.variance["q"]) + EPSILON), rtol=1e-5)
    np.testing.assert_array_equal(by_obs["points"], np.ones((5, 3)))


@pytest.mark.parametrize("name", ["q", "height"])
def test_no_gradient_into_the_statistics(name):
    def mean(a):
        statistics = update(init_statistics({name: SPEC[name]}), {name: a})
        return jnp.sum(statistics.mean[name]) + jnp.sum(statistics.variance[name])

    assert (np.asarray(jax.jit(jax.grad(mean))(observations(3)[name])) == 0.0).all()


def learnt(batches, shape=(1,)):
    """Statistics after some batches of one observation."""
    statistics = init_statistics({"x": ArraySpec(shape)})
    for batch in batches:
        statistics = update(statistics, {"x": jnp.asarray(batch)})
    return statistics


@pytest.mark.parametrize("wild", [9e5, -1e20, 3e38])
def test_one_wild_observation_hardly_moves_the_statistics(wild):
    ordinary = [np.random.default_rng(i).normal(size=(128, 1)).astype(np.float32) for i in range(3)]
    spoilt = [ordinary[0], ordinary[1].copy(), ordinary[2]]
    spoilt[1][7] = wild
    clean, got = learnt(ordinary), learnt(spoilt)
    assert abs(got.mean["x"] - clean.mean["x"]) < WINSOR_WIDTH * 2 / 384
    assert 0.9 < got.variance["x"] / clean.variance["x"] < 1 + 2.2 * WINSOR_WIDTH**2 / 384


def test_a_wild_observation_in_the_first_batch_of_few_is_held_too():
    batch = np.random.default_rng(0).normal(1000.0, 3.0, (8, 1)).astype(np.float32)
    batch[3] = 1e20
    got = learnt([batch])
    assert got.mean["x"] < 1200.0 and np.isfinite(got.variance["x"])


@pytest.mark.parametrize("size", [1.0, 50.0])
@pytest.mark.parametrize("share", [0.002, 0.005, 0.05])
def test_a_flag_or_force_that_is_rare_has_its_true_statistics(share, size):
    """Its quartiles are equal, so only the deviation says what is usual."""
    values = size * (np.random.default_rng(0).random((200, 512, 1)) < share)
    got = init_statistics({"x": ArraySpec((1,))})
    for batch in values.astype(np.float32):
        got = update(got, {"x": batch})
    np.testing.assert_allclose(got.mean["x"], values.mean(), rtol=0.01)
    np.testing.assert_allclose(got.variance["x"], values.var(), rtol=0.01)


def test_one_wild_number_among_equal_ones_is_held():
    batches = [np.zeros((512, 1), np.float32) for _ in range(20)]
    batches[5][7] = 1e20
    assert learnt(batches).variance["x"] < 1.0


def test_observations_of_four_axes_are_vectors():
    batch = np.random.default_rng(0).normal(size=(9, 2, 1, 2, 2)).astype(np.float32)
    got, expected = learnt([batch], batch.shape[1:]), learnt([batch.reshape(9, 8)], (8,))
    np.testing.assert_array_equal(got.variance["x"].reshape(8), expected.variance["x"])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_left_out_sample_by_sample(x64, bad):
    batch = np.random.default_rng(0).normal(size=(16, 3))
    spoilt = batch.copy()
    spoilt[5, 1] = bad
    got, expected = learnt([spoilt], (3,)), learnt([np.delete(batch, 5, axis=0)], (3,))
    assert got.count == 16.0
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), got, expected)


def test_ordinary_numbers_are_never_moved(x64):
    batches = [np.random.default_rng(i).normal(1e4 * i, 1.0 + i, (32, 1)) for i in range(4)]
    got, samples = learnt(batches), np.concatenate([np.zeros((1, 1)), *batches])
    mean = samples.mean()
    np.testing.assert_allclose(got.mean["x"], [mean], rtol=1e-12)
    np.testing.assert_allclose(got.variance["x"], [(1.0 + (samples**2).sum()) / 129 - mean**2], rtol=1e-9)


def test_samples_that_do_not_count_change_nothing():
    statistics = learnt([np.ones((4, 1), np.float32)])
    none = update(statistics, {"x": jnp.full((8, 1), 5.0)}, jnp.zeros(8, bool))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), none, statistics)


def test_normalized_observations_are_clipped_and_pass_no_gradient_there():
    statistics = init_statistics({"x": ArraySpec((2,))})

    def seen(x, clip):
        return normalize(statistics, {"x": x}, clip=clip)["x"]

    x = jnp.array([3.0, -9e5])
    np.testing.assert_allclose(seen(x, 5.0), [3.0, -5.0], rtol=1e-4)
    np.testing.assert_allclose(seen(x, None), x, rtol=1e-4)
    slope = jax.grad(lambda x: seen(x, 5.0).sum())(x)
    np.testing.assert_allclose(slope, [1.0, 0.0], rtol=1e-4)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 100])
@pytest.mark.parametrize("share", [0.25, 0.75])
def test_order_statistics_are_those_of_a_sort(count, share):
    rng = np.random.default_rng(count)
    batch = rng.normal(size=(count, 3)) * 10.0 ** rng.integers(-30, 30, size=(count, 3))
    batch, keep = batch.astype(np.float32), np.arange(count) % 3 != 1
    expected = np.sort(batch[keep], axis=0)[max(int(np.ceil(share * keep.sum())), 1) - 1]
    batch[~keep] = np.nan
    found = _order_statistics(jnp.asarray(batch), jnp.asarray(keep), (0.5, share))
    np.testing.assert_array_equal(found[1], expected)
