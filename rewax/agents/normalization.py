"""Running mean and variance of observations, as a pytree. Outliers are clipped, so that they cannot dominate."""

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.envs.base import ArraySpec
from rewax.types import Array, Observation

EPSILON = 1e-5
WINSOR_WIDTH = 10.0
"""Samples are clipped to the wider of two ranges: this many standard deviations around the running mean, or this many
interquartile ranges beyond the quartiles of their batch."""
RARE_WIDTH = 100.0
"""The same where the quartiles of a batch are equal, as for forces of contacts that are rare. A component that is not
zero in a share p of the samples lies 1/sqrt(p) deviations from its mean there. With a smaller width the deviation of
clipped samples would shrink with every update. With this one it does not for p above 1e-4."""
NEVER_CLIPPED = 1.0
"""Distance from the running mean within which no sample is clipped, for flags that are set even more rarely."""


@struct.dataclass
class RunningStatistics:
    """Mean and variance of all samples so far.

    A vector has a mean and a variance per component. A picture has a mean per pixel and a variance per channel.

    Attributes:
      count: number of samples plus 1, for a prior of mean 0 and variance 1, shape ().
      mean, variance: one array per observation name.
    """

    count: Array
    mean: dict[str, Array]
    variance: dict[str, Array]


def is_normalized(spec: ArraySpec) -> bool:
    """Whether an observation is normalised: vectors and pictures (three axes) are, point clouds (two axes) are not."""
    return len(spec.shape) != 2


def _variance_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    """A picture has one variance per channel: a pixel that hardly ever changes is not magnified."""
    return shape[2:] if len(shape) == 3 else shape


def init_statistics(spec: dict[str, ArraySpec]) -> RunningStatistics:
    """Statistics before the first sample: mean 0, variance 1."""
    shapes = {name: s.shape for name, s in spec.items() if is_normalized(s)}
    return RunningStatistics(
        count=jnp.ones(()),
        mean={name: jnp.zeros(shape) for name, shape in shapes.items()},
        variance={name: jnp.ones(_variance_shape(shape)) for name, shape in shapes.items()},
    )


def update_statistics(statistics: RunningStatistics, obs: Observation, valid: Array | None = None) -> RunningStatistics:
    """Add a batch of observations. Gradient: none.

    Samples are winsorised (``WINSOR_WIDTH``): outliers are clipped to the usual range, so that a value such as 1e20
    among ordinary ones changes the statistics little. A sample with a non-finite component is left out. Pictures are
    bounded, so they are not winsorised.

    Args:
      statistics: the statistics so far.
      obs: observations, with any number of leading axes.
      valid: mask of the samples to use, bool, with the shape of the leading axes; None: all.

    Source: Chan, Golub and LeVeque 1979, pairwise update of mean and variance; winsorising is an addition.
    """
    flat = {name: jax.lax.stop_gradient(obs[name]).reshape(-1, *mean.shape) for name, mean in statistics.mean.items()}
    if not flat:
        return statistics
    keep = jnp.ones(len(next(iter(flat.values()))), bool) if valid is None else valid.reshape(-1)
    for batch in flat.values():
        keep = keep & jnp.all(jnp.isfinite(batch).reshape(len(keep), -1), axis=1)
    added = jnp.sum(keep).astype(statistics.count.dtype)
    total = statistics.count + added
    mean, variance = {}, {}
    pictures = {name for name, mean in statistics.mean.items() if mean.ndim == 3}
    quartiles = _quartiles({name: batch for name, batch in flat.items() if name not in pictures}, keep)
    for name, batch in flat.items():
        old, old_variance = statistics.mean[name], statistics.variance[name]
        if name in quartiles:
            batch = _winsorised(batch, quartiles[name], keep, old, old_variance)
        else:
            batch = jnp.where(keep[:, None, None, None], batch, 0.0)
        batch_mean, batch_variance = _moments(batch, keep, added)
        delta = batch_mean - old
        mean[name] = old + delta * (added / total)
        new = (
            old_variance * statistics.count + batch_variance * added + delta**2 * (statistics.count * added / total)
        ) / total
        variance[name] = new.mean(axis=(0, 1)) if new.ndim == 3 else new
    return RunningStatistics(count=total, mean=mean, variance=variance)


def normalize(statistics: RunningStatistics, obs: Observation, *, clip: float | None = None) -> Observation:
    """(obs - mean) / sqrt(variance + 1e-5) for vectors and pictures; point clouds are returned unchanged.

    Args:
      statistics: running statistics. Gradient: none.
      obs: observations. Gradient: exact, zero where a component is clipped.
      clip: normalised components are clipped to [-clip, clip]; None: no limit.
    """
    statistics = jax.lax.stop_gradient(statistics)

    def one(name: str, a: Array) -> Array:
        if name not in statistics.mean:
            return a
        z = (a - statistics.mean[name]) * jax.lax.rsqrt(statistics.variance[name] + EPSILON)
        return z if clip is None else jnp.clip(z, -clip, clip)

    return {name: one(name, a) for name, a in obs.items()}


def _quartiles(flat: dict[str, Array], keep: Array) -> dict[str, Array]:
    """First and third quartile of each component, shape (2, ...) for each name, in one call for all names."""
    if not flat:
        return {}
    columns = jnp.concatenate([batch.reshape(len(keep), -1) for batch in flat.values()], axis=1)
    found, start = {}, 0
    both = _order_statistics(columns, keep, (0.25, 0.75))
    for name, batch in flat.items():
        size = batch[0].size
        found[name] = both[:, start : start + size].reshape(2, *batch.shape[1:])
        start += size
    return found


def _order_statistics(columns: Array, keep: Array, shares: tuple[float, ...]) -> Array:
    """Quantiles of each column: the smallest sample such that at least the given share of the samples is not larger.

    Finds two bits of the answer at a time, by counting. Counts are sums, so devices keep their own samples. A sort
    would need all samples on one device, and is slower.

    Args:
      columns: shape (n, d).
      keep: mask of the samples to use, shape (n,).

    Returns:
      Shape (len(shares), d).
    """
    size = jnp.finfo(columns.dtype).bits
    unsigned = jnp.dtype(f"uint{size}")
    top = jnp.array(1 << (size - 1), unsigned)
    bits = jax.lax.bitcast_convert_type(columns, unsigned)
    ordered = jnp.where(bits >= top, ~bits, bits | top)  # unsigned integers in the order of the floats
    wanted = jnp.array(shares)[:, None] * jnp.sum(keep)
    digits = jnp.arange(1, 4, dtype=unsigned)[:, None, None]

    def two_bits(i: Array, found: Array) -> Array:
        shift = (size - 2 - 2 * i).astype(unsigned)
        limits = found | (digits << shift)
        below = jnp.sum(keep[:, None] & (ordered < limits[:, :, None]), axis=2)
        return found | (jnp.sum(below < wanted, axis=0).astype(unsigned) << shift)

    found = jax.lax.fori_loop(0, size // 2, two_bits, jnp.zeros((len(shares), columns.shape[1]), unsigned))
    return jax.lax.bitcast_convert_type(jnp.where(found >= top, found ^ top, ~found), columns.dtype)


def _winsorised(batch: Array, quartiles: Array, keep: Array, mean: Array, variance: Array) -> Array:
    """Samples clipped to the usual range. Masked samples are zero."""
    low, high = jnp.where(jnp.any(keep), quartiles, mean)
    between = high - low
    width = jnp.where(between > 0, WINSOR_WIDTH, RARE_WIDTH)
    reach = jnp.maximum(width * jnp.sqrt(variance), NEVER_CLIPPED)
    low = jnp.minimum(mean - reach, low - WINSOR_WIDTH * between)
    high = jnp.maximum(mean + reach, high + WINSOR_WIDTH * between)
    return jnp.where(keep.reshape(-1, *[1] * (batch.ndim - 1)), jnp.clip(batch, low, high), 0.0)


def _moments(batch: Array, keep: Array, count: Array) -> tuple[Array, Array]:
    """Mean and variance of the samples that are not masked."""
    count = jnp.maximum(count, 1.0)
    mean = jnp.sum(batch, axis=0) / count  # masked samples are zero
    off = jnp.where(keep.reshape(-1, *[1] * (batch.ndim - 1)), batch - mean, 0.0)
    return mean, jnp.sum(off**2, axis=0) / count
