"""The signed distance of seen points from the surface of simulated particles: the residual of a fit to clouds."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.types import Array, Scalar

_TINY = 1e-12
_PULL = 0.3
"""Number of points that pull the offset of a particle to the median."""
_SWEEPS = 4


def surface_residuals(particles: Array, cloud: Array, width: Scalar, offsets: Array) -> Array:
    """Signed distance of seen points from the surface of the particles [m], shape (num_points,), positive outside.

    The distance of a point from the local mean of the particles grows across the surface with a slope near 1. Its value
    on the surface, the offset, depends on how densely and evenly the particles lie there.

    Args:
      particles: simulated [m], shape (num_particles, 3).
      cloud: seen [m], shape (num_points, 3).
      width: standard deviation of the Gaussian weights of the mean [m], about the particles' spacing.
      offsets: the value on the surface near each particle [m], shape (num_particles,), see ``surface_offsets``.

    Gradient: exact.
    Source: Zhu & Bridson 2005, "Animating sand as a fluid", with weights that never vanish together, and with offsets
      that follow the particles.
    """
    distance, weights = _distance_from_mean(particles, cloud, width)
    return distance - weights @ offsets


def surface_offsets(particles: Array, cloud: Array, mask: Array, width: Scalar) -> Array:
    """Offsets for which the residuals of a frame vanish on average around each particle [m], shape (num_particles,).

    The first frame shows the body that a simulation begins with. What its surface there lacks in smoothness and shape,
    particles carry along. Particles that no point is near have the median. Gradient: exact.

    Args:
      particles, cloud, width: as in ``surface_residuals``.
      mask: which points exist, shape (num_points,), bool.
    """
    distance, weights = _distance_from_mean(particles, cloud, width)
    median = jnp.nan_to_num(jnp.nanmedian(jnp.where(mask, distance, jnp.nan)))
    weights = jnp.where(mask[:, None], weights, 0.0)
    near = weights.sum(0)
    offsets = (weights.T @ distance + _PULL * median) / (near + _PULL)
    for _ in range(_SWEEPS):  # towards residuals of zero at the points themselves
        left = jnp.where(mask, distance - weights @ offsets, 0.0)
        offsets = offsets + (weights.T @ left) / (near + _PULL)
    return offsets


def _distance_from_mean(particles: Array, cloud: Array, width: Scalar) -> tuple[Array, Array]:
    """Distance of points from the local mean [m], shape (num_points,); weights of the particles, rows sum to 1."""
    squared = ((cloud[:, None] - particles[None]) ** 2).sum(-1)
    weights = jax.nn.softmax(-0.5 * squared / width**2, axis=-1)
    mean = weights @ particles
    return jnp.sqrt(((cloud - mean) ** 2).sum(-1) + _TINY), weights


def particle_spacing(particles: np.ndarray) -> float:
    """Cube root of the volume per particle [m], from distances to the eighth neighbours of up to 256 particles."""
    x = np.asarray(particles, float)
    some = x[:: max(1, len(x) // 256)]
    distance = np.sqrt(((some[:, None] - x[None]) ** 2).sum(-1))
    rank = min(8, len(x) - 1)
    # A ball with nine particles (its centre's included) of volume s^3 each has the radius s (9 / (4 pi / 3))^(1/3).
    return float(
        np.median(np.partition(distance, rank, axis=1)[:, rank]) / ((rank + 1) / (4.0 * np.pi / 3.0)) ** (1 / 3)
    )


__all__ = ["particle_spacing", "surface_offsets", "surface_residuals"]
