"""How sure a mean is: bootstrap intervals and interquartile means of returns."""

from collections.abc import Sequence

import numpy as np


def bootstrap_interval(
    values: Sequence[float] | np.ndarray, *, confidence: float = 0.95, num_resamples: int = 10_000, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean.

    Args:
      values: independent samples, such as returns of episodes or of seeds; at least one.
      confidence: of the interval [-].
      num_resamples: draws with replacement.
      seed: of the draws: the same values always give the same interval.

    Returns:
      Lower and upper end; both the value itself if there is but one.
    Source: Efron 1979.
    """
    values = np.asarray(values, np.float64)
    draws = np.random.default_rng(seed).integers(0, len(values), (num_resamples, len(values)))
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(values[draws].mean(axis=1), [tail, 100.0 - tail])
    return float(low), float(high)


def interquartile_mean(values: Sequence[float] | np.ndarray) -> float:
    """Mean of the middle half of the values: a quarter is cut off at either end, values at the border in part.

    Source: Agarwal et al. 2021, Deep Reinforcement Learning at the Edge of the Statistical Precipice.
    """
    values = np.sort(np.asarray(values, np.float64))
    place = np.arange(len(values))
    quarter = len(values) / 4.0
    weight = np.clip(np.minimum(place + 1, len(values) - quarter) - np.maximum(place, quarter), 0.0, 1.0)
    return float(np.sum(weight * values) / np.sum(weight))
