"""Running mean and variance of observations, as a pytree."""

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.envs.base import ArraySpec
from rewax.types import Array, Observation

EPSILON = 1e-5


@struct.dataclass
class RunningStatistics:
    """Mean and variance of everything seen so far, per component of the vector observations.

    Attributes:
      count: number of samples, starting at 1 (a prior of mean 0 and variance 1), shape ().
      mean, variance: by name of the observation.
    """

    count: Array
    mean: dict[str, Array]
    variance: dict[str, Array]


def is_vector(spec: ArraySpec) -> bool:
    """Vectors are normalised, point clouds (two axes) are not."""
    return len(spec.shape) < 2


def init_statistics(spec: dict[str, ArraySpec]) -> RunningStatistics:
    """Statistics of nothing: mean 0, variance 1."""
    shapes = {name: s.shape for name, s in spec.items() if is_vector(s)}
    return RunningStatistics(
        count=jnp.ones(()),
        mean={name: jnp.zeros(shape) for name, shape in shapes.items()},
        variance={name: jnp.ones(shape) for name, shape in shapes.items()},
    )


def update_statistics(statistics: RunningStatistics, obs: Observation) -> RunningStatistics:
    """Add a batch of observations with any number of leading axes. Gradient: none.

    Source: Chan, Golub and LeVeque 1979, pairwise update of mean and variance.
    """
    mean, variance, count, added = {}, {}, statistics.count, 0
    for name, old_mean in statistics.mean.items():
        batch = jax.lax.stop_gradient(obs[name]).reshape(-1, *old_mean.shape)
        added = batch.shape[0]
        total = count + added
        delta = batch.mean(0) - old_mean
        mean[name] = old_mean + delta * (added / total)
        spread = statistics.variance[name] * count + batch.var(0) * added + delta**2 * (count * added / total)
        variance[name] = spread / total
    return RunningStatistics(count=count + added, mean=mean, variance=variance)


def normalize(statistics: RunningStatistics, obs: Observation) -> Observation:
    """(obs - mean) / sqrt(variance + 1e-5) for vectors, others unchanged. Gradient: with respect to obs only."""
    statistics = jax.lax.stop_gradient(statistics)

    def one(name: str, a: Array) -> Array:
        if name not in statistics.mean:
            return a
        return (a - statistics.mean[name]) * jax.lax.rsqrt(statistics.variance[name] + EPSILON)

    return {name: one(name, a) for name, a in obs.items()}
