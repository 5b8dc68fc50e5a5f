"""Random position and size of a soft body at the beginning of an episode."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.types import Array, Key, Scalar, Vector


@struct.dataclass
class ResetNoise(struct.Replaceable):
    """A uniform random shift of all points, then a uniform random stretch about the origin.

    Attributes:
      shift_lower, shift_upper: range of the shift [m], shape (3,).
      stretch: the factor of the coordinates lies within 1 - stretch and 1 + stretch [-].
    """

    shift_lower: Vector
    shift_upper: Vector
    stretch: Scalar

    def apply(self, positions: Array, shift_key: Key, stretch_key: Key) -> Array:
        """Positions at the beginning of an episode [m], shape (num_points, 3).

        Gradient: exact with respect to positions; with respect to the bounds as if draws were not rounded.
        Source: Rewarped, which rounds draws to thousandths of their bound.
        """
        shift = jax.random.uniform(shift_key, (3,), minval=self.shift_lower, maxval=self.shift_upper)
        shift = round_unit(shift, jnp.maximum(jnp.abs(self.shift_lower), jnp.abs(self.shift_upper)))
        stretch = self.stretch * jax.random.uniform(stretch_key, (), minval=-1.0, maxval=1.0)
        stretch = round_unit(stretch, jnp.abs(self.stretch))
        return (positions + shift) * (1.0 + stretch)


def no_noise() -> ResetNoise:
    """No noise: every episode begins with the same positions."""
    return reset_noise((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)


def reset_noise(
    lower: tuple[float, float, float], upper: tuple[float, float, float], stretch: float = 0.0
) -> ResetNoise:
    """A ``ResetNoise`` from Python numbers; raises ValueError for an empty range or a negative stretch."""
    if not (np.all(np.asarray(lower) <= np.asarray(upper)) and stretch >= 0.0):
        raise ValueError(
            f"the noise of a reset is {lower} to {upper} with stretch {stretch}: give a lower end below the upper one, "
            "and a stretch of 0 or more"
        )
    return ResetNoise(shift_lower=lower, shift_upper=upper, stretch=stretch)


def round_unit(value: Array, bound: Array) -> Array:
    """``value`` rounded to thousandths of ``bound``, as in Rewarped. Gradient: as if it were not rounded."""
    unit = value / jnp.where(bound > 0.0, bound, 1.0)
    return value + jax.lax.stop_gradient(jnp.round(unit * 1000.0) / 1000.0 * bound - value)
