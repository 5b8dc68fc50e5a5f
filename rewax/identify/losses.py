"""Losses between observed and simulated points: pure functions of one frame.

A cloud has a fixed maximal size; ``mask`` is True for points that exist. Batch with ``jax.vmap``. Losses of distances
are Huber losses [m^2]: half the square up to ``delta``, linear beyond. Losses are finite for coinciding points.
"""

import jax
import jax.numpy as jnp

from rewax.sensors.camera import Camera
from rewax.sensors.world import World
from rewax.types import Array, Scalar

_TINY = 1e-12
"""Added to squared lengths [m^2], so that the root of zero has a derivative."""


def huber(residual: Array, delta: Scalar) -> Array:
    """Half the square of a residual up to ``delta``, beyond it linear; same shape.

    Args:
      residual: any shape.
      delta: where the linear part begins, > 0, in the unit of the residual.

    Gradient: exact, continuous.
    Source: Huber 1964, "Robust estimation of a location parameter".
    """
    size = jnp.abs(residual)
    quadratic = jnp.minimum(size, delta)
    return quadratic * (size - 0.5 * quadratic)


def huber_weight(residual: Array, delta: Scalar) -> Array:
    """The weight of a residual in iteratively reweighted least squares, huber'(r) / r. Gradient: none."""
    size = jax.lax.stop_gradient(jnp.abs(residual))
    return delta / jnp.maximum(size, delta)


def trimmed_mean(values: Array, mask: Array, trim: float = 0.0) -> Array:
    """The mean of the smallest values, shape ().

    Args:
      values: shape (n,).
      mask: which of them exist, shape (n,), bool.
      trim: share of the largest existing values that is left out, in [0, 1).

    Returns:
      The mean, 0 if no value exists.

    Raises:
      ValueError: ``trim`` is not in [0, 1).

    Gradient: exact for the values that are kept.
    """
    if not 0.0 <= trim < 1.0:
        raise ValueError(f"trim is {trim}: give a share in [0, 1)")
    count = mask.sum()
    keep = jnp.ceil((1.0 - trim) * count).astype(jnp.int32)
    rank = jnp.argsort(jnp.argsort(jnp.where(mask, jax.lax.stop_gradient(values), jnp.inf)))
    kept = mask & (rank < keep)
    return jnp.where(kept, values, 0.0).sum() / jnp.maximum(kept.sum(), 1)


def nearest_distances(points: Array, others: Array, mask: Array | None = None) -> Array:
    """Distance from each point to the nearest of others [m], shape (n,).

    Args:
      points: shape (n, 3).
      others: shape (m, 3).
      mask: which of the others exist, shape (m,), bool; None: all. If none does, distances are 0.

    Gradient: exact for the pair that is nearest; zero where points coincide.
    """
    squared = ((points[:, None] - others[None]) ** 2).sum(-1)
    exists = jnp.ones(len(others), bool) if mask is None else mask
    nearest = jnp.argmin(jnp.where(exists, squared, jnp.inf), axis=1)
    gap = points - others[nearest]
    return jnp.where(exists.any(), jnp.sqrt((gap**2).sum(-1) + _TINY) - _TINY**0.5, 0.0)


def one_sided_chamfer(particles: Array, cloud: Array, mask: Array, *, delta: Scalar = 1.0, trim: float = 0.0) -> Array:
    """Mean Huber loss of the distances from seen points to the nearest particle [m^2], shape ().

    For clouds that show only a part of the body: particles that were not seen cost nothing.

    Args:
      particles: simulated [m], shape (num_particles, 3).
      cloud: seen [m], shape (num_points, 3).
      mask: which seen points exist, shape (num_points,), bool.
      delta: distance beyond which the loss is linear instead of quadratic [m], see ``huber``.
      trim: share of the largest losses that is left out, in [0, 1).

    Raises:
      ValueError: ``trim`` is not in [0, 1).

    Gradient: exact. It jumps where another particle becomes the nearest.
    """
    return trimmed_mean(huber(nearest_distances(_seen(cloud, mask), particles), delta), mask, trim)


def chamfer(particles: Array, cloud: Array, mask: Array, *, delta: Scalar = 1.0, trim: float = 0.0) -> Array:
    """``one_sided_chamfer`` plus the same from particles to seen points [m^2], shape (). For clouds of the whole body.

    Arguments, errors and gradient as for ``one_sided_chamfer``.
    """
    back = huber(nearest_distances(particles, _seen(cloud, mask), mask), delta)
    everything = jnp.broadcast_to(mask.any(), back.shape)
    return one_sided_chamfer(particles, cloud, mask, delta=delta, trim=trim) + trimmed_mean(back, everything, trim)


def matched(particles: Array, cloud: Array, mask: Array, *, delta: Scalar = 1.0) -> Array:
    """Mean Huber loss of the distances between points of one index [m^2], shape (): for tracked markers.

    Arguments as for ``one_sided_chamfer``.

    Raises:
      ValueError: there are more seen points than particles.

    Gradient: exact.
    """
    if len(particles) < len(cloud):
        raise ValueError(
            f"there are {len(cloud)} seen points and {len(particles)} particles: give no more points than particles, "
            "because each is compared with the particle of its index"
        )
    gap = jnp.sqrt(((particles[: len(cloud)] - _seen(cloud, mask)) ** 2).sum(-1) + _TINY)
    return trimmed_mean(huber(gap, delta), mask)


def _seen(cloud: Array, mask: Array) -> Array:
    """The points that exist, and zeros, since what does not exist may be NaN, and so would be the gradient."""
    return jnp.where(mask[:, None], cloud, 0.0)


def occupancy(
    particles: Array, cloud: Array, mask: Array, *, lower: Array, spacing: Scalar, shape: tuple[int, int, int]
) -> Array:
    """Sum over the nodes of a grid of the squared difference of the shares of points [-], shape ().

    Each point counts at the eight nodes of its cell with linear weights. The sum is 0 if no seen point exists.

    Args:
      particles, cloud, mask: as in ``one_sided_chamfer``.
      lower: corner of the grid [m], shape (3,). Points outside count at the border.
      spacing: size of a cell [m].
      shape: numbers of nodes along the axes (static).

    Gradient: exact; weights have kinks at nodes.
    """

    def density(points: Array, exists: Array) -> Array:
        limit = jnp.asarray(shape, points.dtype) - 1.001
        cell = jnp.clip((points - lower) / spacing, 0.0, limit)
        base = jnp.floor(jax.lax.stop_gradient(cell)).astype(jnp.int32)
        fraction = cell - base
        total = jnp.zeros(shape, points.dtype)
        for corner in range(8):
            bits = jnp.asarray([(corner >> i) & 1 for i in range(3)])
            weight = jnp.where(bits == 1, fraction, 1.0 - fraction).prod(-1)
            i, j, k = (base + bits).T
            total = total.at[i, j, k].add(jnp.where(exists, weight, 0.0))
        return total / jnp.maximum(exists.sum(), 1)

    difference = density(particles, jnp.ones(len(particles), bool)) - density(_seen(cloud, mask), mask)
    return jnp.where(mask.any(), (difference**2).sum(), 0.0)


def depth_picture(camera: Camera, world: World, seen: Array, *, delta: Scalar = 1.0) -> Array:
    """Mean Huber loss of depth over the pixels that see something in both pictures [m^2], shape ().

    Args:
      camera: ``gradient=True`` gives derivatives.
      world: simulated.
      seen: the camera's picture [m], shape (height, width); 0, or ``camera.far`` and more, where nothing was seen.
      delta: difference beyond which the loss is linear [m].

    Gradient: that of ``Camera.view``: exact for the surface that a pixel sees; none at outlines.
    """
    depth = camera.depth(world)
    both = (seen > 0) & (seen < camera.far) & (depth < camera.far)
    difference = jnp.where(both, depth - seen, 0.0)
    return huber(difference, delta).sum() / jnp.maximum(both.sum(), 1)


def over_time(losses: Array, weights: Array) -> Array:
    """Weighted mean of the losses of frames, shape (num_frames,) each; 0 if all weights are.

    A frame with weight 0 has no part in it, even if its loss is not finite. Gradient: exact.
    """
    total = weights.sum()
    return (jnp.where(weights > 0, losses, 0.0) * weights).sum() / jnp.where(total > 0, total, 1.0)


__all__ = [
    "chamfer", "depth_picture", "huber", "huber_weight", "matched", "nearest_distances", "occupancy",
    "one_sided_chamfer", "over_time", "trimmed_mean",
]  # fmt: skip
