"""Errors of real depth cameras: noise that grows with distance, steps, and holes at edges."""

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.physics.numerics.checks import NOT_NEGATIVE, PROBABILITY, check_numbers, numbers_of
from rewax.types import Array, Key, Scalar


@struct.dataclass
class DepthNoise(struct.Replaceable):
    """Errors of a depth camera; the defaults are those of no errors.

    Attributes:
      constant, quadratic: the standard deviation is constant + quadratic * depth^2 [m, 1/m]. For a Kinect take 0.0008
        and 0.0013: from 0.5 to 3 m this is within 12 % of 0.0012 + 0.0019 (depth - 0.4)^2 (Nguyen et al. 2012,
        "Modeling Kinect sensor noise for improved 3D reconstruction and tracking").
      step: depths are rounded to multiples of this [m]; 0: not.
      edge_holes: probability that a pixel at an edge sees nothing [-].
      edge: jump of depth to a neighbouring pixel above which there is an edge [m].
      dropout: probability that any pixel sees nothing [-].

    Raises:
      ValueError: a number is below 0, or a probability above 1.
    """

    constant: Scalar = struct.number(NOT_NEGATIVE, "give a length in metres", default=0.0)
    quadratic: Scalar = struct.number(NOT_NEGATIVE, "give a number of 1/m", default=0.0)
    step: Scalar = struct.number(NOT_NEGATIVE, "give a length in metres", default=0.0)
    edge_holes: Scalar = struct.number(PROBABILITY, "give a probability", default=0.0)
    edge: Scalar = struct.number(NOT_NEGATIVE, "give a length in metres", default=0.02)
    dropout: Scalar = struct.number(PROBABILITY, "give a probability", default=0.0)

    def __post_init__(self) -> None:
        check_numbers(numbers_of(self, "DepthNoise."))

    def apply(self, depth: Array, far: float, key: Key) -> Array:
        """A picture with these errors.

        Args:
          depth: [m], shape (height, width).
          far: depth of pixels that see nothing [m].
          key: for the draws.

        Gradient: exact with respect to ``depth``; zero where a pixel sees nothing. Rounding passes it unchanged.
        """
        noise_key, edge_key, drop_key = jax.random.split(key, 3)
        seen = depth < far
        deviation = self.constant + self.quadratic * depth**2
        noisy = depth + deviation * jax.random.normal(noise_key, depth.shape, depth.dtype)
        steps = jnp.where(self.step > 0, self.step, 1.0)
        rounding = jax.lax.stop_gradient(jnp.round(noisy / steps) * steps - noisy)
        noisy = noisy + jnp.where(self.step > 0, rounding, 0.0)
        at_edge = _jump(depth) > self.edge
        lost = at_edge & jax.random.bernoulli(edge_key, self.edge_holes, depth.shape)
        lost |= jax.random.bernoulli(drop_key, self.dropout, depth.shape)
        return jnp.where(seen & ~lost, jnp.clip(noisy, 0.0, far), far)


def _jump(depth: Array) -> Array:
    """Largest difference to one of the four neighbours [m]."""
    padded = jnp.pad(depth, 1, mode="edge")
    neighbours = (padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:])
    return jnp.stack([jnp.abs(other - depth) for other in neighbours]).max(axis=0)


__all__ = ["DepthNoise"]
