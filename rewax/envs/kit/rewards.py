"""Smooth terms for rewards. Their derivatives are finite everywhere and not zero where a policy has to learn.

First-order methods follow the derivative of a reward. The derivative of a step (``d < 0.02``) is zero, that of a norm
is undefined at zero, and a square grows without bound, so that one bad episode outweighs the rest. Except where shapes
are given, the functions act on each number of an array. Gradients are exact.
"""

import jax
import jax.numpy as jnp

from rewax.types import Array, Scalar


def smooth_norm(vector: Array, width: Scalar = 1e-3) -> Array:
    """Norm of vectors, smooth at zero: sqrt(|x|^2 + width^2) - width, (..., n) -> (...).

    Args:
      vector: vectors [any unit].
      width: length below which the function is nearly a parabola [the same unit], > 0. Its derivative at zero is zero.
    """
    return jnp.sqrt(jnp.sum(vector * vector, axis=-1) + width * width) - width


def near(distance: Array, scale: Scalar) -> Array:
    """1 / (1 + (distance / scale)^2): 1 at distance 0, 1/2 at ``scale``, near 0 far away.

    The slope is steepest at 0.58 ``scale``; at 4 times the scale it is 23 times smaller. Choose a scale near the
    distances at the beginning of an episode.
    """
    return 1.0 / (1.0 + (distance / scale) ** 2)


def beyond(value: Array, limit: Scalar, width: Scalar) -> Array:
    """Smooth excess over a limit: width log(1 + exp((value - limit) / width)) [unit of value].

    A penalty on it has a slope from about ``limit - 3 width`` on, where the hinge ``max(value - limit, 0)`` has none.
    """
    return width * jax.nn.softplus((value - limit) / width)


def share_beyond(value: Array, limit: Scalar, width: Scalar) -> Array:
    """sigmoid((value - limit) / width): 0 well below the limit, 1/2 at it, 1 well above.

    The mean over particles is the share of particles beyond the limit. Only particles within some widths of the limit
    contribute to its slope: a width of 1e-5 of the distances that occur makes it a step.
    """
    return jax.nn.sigmoid((value - limit) / width)


def smooth_min(values: Array, width: Scalar) -> Array:
    """Smooth minimum, (..., n) -> (...): the mean with weights exp(-value / width) [unit of values].

    It is never below the minimum. Values within ``width`` of the minimum share the gradient.
    """
    weights = jax.nn.softmax(-values / width, axis=-1)
    return jnp.sum(weights * values, axis=-1)
