"""Confidence intervals and interquartile means of returns; learning curves."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

_BLOCK = 2**20
"""Numbers that are drawn at once."""


def bootstrap_interval(
    values: Sequence[float] | np.ndarray, *, confidence: float = 0.95, num_resamples: int = 10_000, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean.

    Args:
      values: independent samples, such as returns of episodes or of seeds; at least one.
      confidence: confidence level of the interval [-].
      num_resamples: number of resamples with replacement.
      seed: random seed; the same values always give the same interval.

    Returns:
      Lower and upper end. For a single value both are the value.
    Source: Efron 1979.
    """
    values = np.asarray(values, np.float64)
    generator, count = np.random.default_rng(seed), len(values)
    rows = max(1, _BLOCK // max(1, count))
    sizes = [min(rows, num_resamples - begun) for begun in range(0, num_resamples, rows)]
    means = np.concatenate([values[generator.integers(0, count, (size, count))].mean(axis=1) for size in sizes])
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(means, [tail, 100.0 - tail])
    return float(low), float(high)


def student_interval(values: Sequence[float] | np.ndarray, *, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of the mean of few samples, by Student's t distribution.

    The bootstrap of three values yields an interval that is far too short.

    Args:
      values: independent, approximately normal samples, such as returns of seeds; at least two.
      confidence: confidence level of the interval [-].

    Returns:
      Lower and upper end.
    Source: Student 1908, The probable error of a mean.
    """
    from scipy.special import stdtrit

    values = np.asarray(values, np.float64)
    count = len(values)
    half = stdtrit(count - 1, 0.5 + 0.5 * confidence) * values.std(ddof=1) / np.sqrt(count)
    return float(values.mean() - half), float(values.mean() + half)


def interquartile_mean(values: Sequence[float] | np.ndarray) -> float:
    """Mean of the middle half of the values; values at the borders of the half count in part.

    Source: Agarwal et al. 2021, Deep Reinforcement Learning at the Edge of the Statistical Precipice.
    """
    values = np.sort(np.asarray(values, np.float64))
    index = np.arange(len(values))
    quarter = len(values) / 4.0
    weight = np.clip(np.minimum(index + 1, len(values) - quarter) - np.maximum(index, quarter), 0.0, 1.0)
    return float(np.sum(weight * values) / np.sum(weight))


class Curve(NamedTuple):
    """A learning curve.

    Attributes:
      steps: environment steps, increasing, shape (points,).
      returns: mean return of recent episodes at these steps, shape (points,).
    """

    steps: np.ndarray
    returns: np.ndarray

    def at(self, steps: np.ndarray) -> "Curve":
        """The curve, interpolated at other steps."""
        return Curve(steps, np.interp(steps, self.steps, self.returns))


def learning_curve(columns: Mapping[str, np.ndarray], *, decay: float = 0.9) -> Curve:
    """Exponentially weighted mean returns of finished episodes; the curve has no points if none finished.

    Args:
      columns: ``env_steps`` and ``return`` of a run's ``metrics.csv``; ``return`` is NaN where no episode ended.
      decay: decay of the weights per row.
    """
    ended = np.isfinite(columns.get("return", np.zeros(0)))
    steps, returns = (columns[name][ended] if ended.any() else np.zeros(0) for name in ("env_steps", "return"))
    means, total, weight = np.empty_like(returns), 0.0, 0.0
    for i, value in enumerate(returns):
        total, weight = decay * total + value, decay * weight + 1.0
        means[i] = total / weight
    return Curve(steps, means)
