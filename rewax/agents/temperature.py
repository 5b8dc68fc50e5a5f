"""Entropy and its price, the temperature."""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from rewax.agents.gradients import finite_or_zero
from rewax.agents.optimizers import apply
from rewax.types import Array, PyTree


def normalized_entropy(entropy: Array, target: float) -> Array:
    """(entropy + |target|) / (2 |target|): 0 at a negative target, 1 at minus the target. Gradient: exact.

    Source: SAPO, Xing, Luk and Oh 2025; the reference's "offset and scale".
    """
    size = abs(target)
    return (entropy + size) * (0.5 / size)


def temperature_loss(log_temperature: Array, entropy: Array, target: float) -> Array:
    """exp(log_temperature) |target| (entropy - target). Its gradient raises the temperature below the target.

    The factor |target| makes up for the scale of ``normalized_entropy``.

    Args:
      log_temperature: shape ().
      entropy: mean over the data, shape (). Gradient: none.
      target: of the entropy.
    """
    return jnp.exp(log_temperature) * abs(target) * (jax.lax.stop_gradient(entropy) - target)


def update_temperature(
    log_temperature: Array,
    temperature_opt: PyTree,
    *,
    entropy: Array,
    target: float,
    optimizer: optax.GradientTransformation,
) -> dict[str, Any]:
    """One step towards the target entropy; the gradient of a loss that is not finite counts as zero.

    Returns:
      The new ``log_temperature`` and ``temperature_opt``.
    """
    grad = finite_or_zero(jax.grad(temperature_loss)(log_temperature, entropy, target))
    log_temperature, temperature_opt = apply(optimizer, grad, temperature_opt, log_temperature)
    return {"log_temperature": log_temperature, "temperature_opt": temperature_opt}
