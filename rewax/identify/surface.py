"""The signed distance of seen points from the surface of simulated particles: the residual of a fit to clouds."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.types import Array, Scalar

_TINY = 1e-12


def distance_from_mean(particles: Array, cloud: Array, width: Scalar) -> Array:
    """Distance of seen points from the local mean of the particles [m], shape (num_points,).

    It grows outwards across the surface with a slope near 1, and is constant on a flat surface. The value there
    depends on the density of particles; ``surface_residuals`` subtracts it.

    Args:
      particles: simulated [m], shape (num_particles, 3).
      cloud: seen [m], shape (num_points, 3).
      width: standard deviation of the Gaussian weights of the mean [m], about the particles' spacing.

    Gradient: exact.
    Source: Zhu & Bridson 2005, "Animating sand as a fluid", with weights that never vanish together.
    """
    squared = ((cloud[:, None] - particles[None]) ** 2).sum(-1)
    weights = jax.nn.softmax(-0.5 * squared / width**2, axis=-1)
    mean = weights @ particles
    return jnp.sqrt(((cloud - mean) ** 2).sum(-1) + _TINY)


def surface_residuals(particles: Array, cloud: Array, width: Scalar, offset: Scalar) -> Array:
    """Signed distance of seen points from the surface of the particles [m], shape (num_points,).

    Args:
      particles, cloud, width: as in ``distance_from_mean``.
      offset: the value of ``distance_from_mean`` on the surface [m], see ``surface_offset``.
    """
    return distance_from_mean(particles, cloud, width) - offset


def surface_offset(particles: Array, cloud: Array, mask: Array, width: Scalar) -> Array:
    """The offset for which the residuals of a frame have the median zero [m], shape (). Gradient: none.

    The first frame shows the body that the simulation begins with, so its offset holds for all frames.
    """
    depth = jax.lax.stop_gradient(distance_from_mean(particles, cloud, width))
    return jnp.nan_to_num(jnp.nanmedian(jnp.where(mask, depth, jnp.nan)))


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


__all__ = ["distance_from_mean", "particle_spacing", "surface_offset", "surface_residuals"]
