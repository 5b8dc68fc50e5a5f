"""Clipping whose derivative at a bound is that of the inside."""

import jax.numpy as jnp

from rewax.types import Array, Scalar


def clipped(value: Array, low: Array | Scalar, high: Array | Scalar) -> Array:
    """``jnp.clip`` with arrays that broadcast to the shape of ``value``.

    Gradient: exact. At a bound itself that of the inside, so 1 by ``value``. ``jnp.clip`` has 1/2 there, and a rollout
    that stays at the bound multiplies these halves.
    """
    return jnp.where(value < low, low, jnp.where(value > high, high, value))


__all__ = ["clipped"]
