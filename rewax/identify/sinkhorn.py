"""The Sinkhorn divergence of two clouds, through ott-jax."""

import jax.numpy as jnp

from rewax.types import Array


def sinkhorn_divergence(particles: Array, cloud: Array, mask: Array, *, epsilon: float = 1e-3) -> Array:
    """Entropic transport cost between particles and a cloud, without its bias: 0 for equal clouds [m^2], shape ().

    It compares whole bodies. It has no one-sided form, so give it clouds from all sides.

    Args:
      particles: simulated [m], shape (num_particles, 3), all of the same weight.
      cloud: seen [m], shape (num_points, 3).
      mask: which seen points exist, shape (num_points,), bool; at least one.
      epsilon: entropic regularisation [m^2]: the square of the length over which transport is blurred.

    Raises:
      ValueError: ott-jax is not installed.

    Gradient: exact at convergence (the envelope theorem), with respect to both clouds.
    Source: Feydy et al. 2019, "Interpolating between optimal transport and MMD using Sinkhorn divergences".
    """
    try:
        from ott.geometry import pointcloud  # pyright: ignore[reportMissingImports]
        from ott.tools import sinkhorn_divergence as ott_divergence  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError("the Sinkhorn divergence needs ott-jax: pip install 'rewax[identify]'") from None

    share = mask / jnp.maximum(mask.sum(), 1)
    uniform = jnp.full(len(particles), 1.0 / len(particles), particles.dtype)
    here = jnp.where(mask[:, None], cloud, particles[:1])  # points of weight zero, at a finite place
    value, _ = ott_divergence.sinkhorn_divergence(
        pointcloud.PointCloud, particles, here, epsilon=epsilon, a=uniform, b=share.astype(particles.dtype)
    )
    return value


__all__ = ["sinkhorn_divergence"]
