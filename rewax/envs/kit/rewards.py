"""Smooth pieces of rewards: what has a slope where a policy has to learn, and a finite one everywhere.

First-order methods follow the derivative of a reward. Steps (``d < 0.02``) have none; norms have none at zero; squares
grow without bound, so that one episode gone astray outweighs the rest. All functions act on each number of an array;
gradients are exact.
"""

import jax
import jax.numpy as jnp

from rewax.types import Array, Scalar


def smooth_norm(vector: Array, width: Scalar = 1e-3) -> Array:
    """Length of vectors, rounded at zero: sqrt(|x|^2 + width^2) - width, (..., n) -> (...).

    Args:
      vector: [any unit].
      width: below about this length it is a parabola [the same unit], > 0. The derivative at zero is zero.
    """
    return jnp.sqrt(jnp.sum(vector * vector, axis=-1) + width * width) - width


def near(distance: Array, scale: Scalar) -> Array:
    """1 at distance 0, 1/2 at ``scale``, towards 0 far away: 1 / (1 + (distance / scale)^2).

    It is steepest at 0.58 ``scale``. Choose the distances that episodes begin with for the scale: at 4 times the scale
    the slope is a twenty-third of the steepest.
    """
    return 1.0 / (1.0 + (distance / scale) ** 2)


def beyond(value: Array, limit: Scalar, width: Scalar) -> Array:
    """By how much a value exceeds a limit, smoothly: width log(1 + exp((value - limit) / width)) [its unit].

    A penalty for it has a slope from about ``3 width`` before the limit on; there a hinge ``max(value - limit, 0)`` has
    none.
    """
    return width * jax.nn.softplus((value - limit) / width)


def share_beyond(value: Array, limit: Scalar, width: Scalar) -> Array:
    """0 well below a limit, 1/2 at it, 1 well above: sigmoid((value - limit) / width).

    The mean over particles is the share of them beyond it. Its slope is that of particles within some widths of the
    limit: a width of 1e-5 of the distances that occur makes it a step.
    """
    return jax.nn.sigmoid((value - limit) / width)


def smooth_min(values: Array, width: Scalar) -> Array:
    """The least of several values, (..., n) -> (...), as a mean with weights exp(-value / width) [their unit].

    Values within ``width`` of the least share the gradient; never below the least itself.
    """
    weights = jax.nn.softmax(-values / width, axis=-1)
    return jnp.sum(weights * values, axis=-1)
