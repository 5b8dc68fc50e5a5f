"""Intervals of means, interquartile means, learning curves."""

import numpy as np
import pytest
from scipy import stats

from rewax import statistics
from rewax.statistics import bootstrap_interval, interquartile_mean, learning_curve, student_interval


def test_the_interval_of_many_samples_is_that_of_the_normal_distribution():
    values = np.random.default_rng(0).normal(3.0, 2.0, 400)
    low, high = bootstrap_interval(values)
    half = 1.96 * values.std() / 20.0
    np.testing.assert_allclose([low, high], [values.mean() - half, values.mean() + half], atol=0.02)
    assert bootstrap_interval(values) == (low, high)
    assert bootstrap_interval([4.0]) == (4.0, 4.0)
    wide, narrow = (np.diff(bootstrap_interval(values, confidence=c))[0] for c in (0.99, 0.5))
    assert wide > 2.0 * narrow


def test_resamples_in_blocks_are_those_of_one_draw(monkeypatch):
    values = np.random.default_rng(0).normal(3.0, 2.0, 37)
    at_once = bootstrap_interval(values)
    monkeypatch.setattr(statistics, "_BLOCK", 100)
    assert bootstrap_interval(values) == at_once


def test_the_interval_of_three_samples_holds_the_mean_in_95_of_100_cases():
    """Where the bootstrap's holds it in 68."""
    draws = np.random.default_rng(0).normal(3.0, 2.0, (2000, 3))
    share = {
        of: np.mean([low <= 3.0 <= high for low, high in map(of, draws)])
        for of in (student_interval, lambda values: bootstrap_interval(values, num_resamples=200))
    }
    student, resampled = share.values()
    assert student == pytest.approx(0.95, abs=0.015) and resampled < 0.8
    expected = stats.t.interval(0.9, 2, loc=draws[0].mean(), scale=stats.sem(draws[0]))
    np.testing.assert_allclose(student_interval(draws[0], confidence=0.9), expected)


@pytest.mark.parametrize("count", [4, 8, 20])
def test_the_interquartile_mean_is_a_trimmed_mean(count):
    values = np.random.default_rng(count).normal(size=count)
    assert interquartile_mean(values) == pytest.approx(stats.trim_mean(values, 0.25))


def test_a_value_at_the_border_counts_in_part():
    assert interquartile_mean([1.0, 2.0, 9.0]) == pytest.approx((0.25 * 1 + 2 + 0.25 * 9) / 1.5)
    assert interquartile_mean([5.0]) == 5.0


def test_a_learning_curve_weighs_the_past_and_leaves_out_what_is_unknown():
    columns = {"env_steps": np.arange(4.0), "return": np.array([1.0, np.nan, 3.0, 5.0])}
    steps, means = learning_curve(columns, decay=0.5)
    np.testing.assert_array_equal(steps, [0.0, 2.0, 3.0])
    np.testing.assert_allclose(means, [1.0, (0.5 + 3.0) / 1.5, (0.25 + 1.5 + 5.0) / 1.75])
    for nothing in ({"env_steps": np.arange(2.0), "return": np.full(2, np.nan)}, {}):
        assert learning_curve(nothing).steps.size == 0
