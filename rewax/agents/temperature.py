"""Entropy and its price, the temperature."""

from typing import TypeVar

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.agents.actor_critic import Actor
from rewax.agents.base import Metrics
from rewax.agents.config import AnyPolicyConfig
from rewax.agents.run_state import ActorCriticState
from rewax.types import Array, PyTree


@struct.dataclass
class SoftState(ActorCriticState):
    """That of an algorithm with critics and a temperature.

    Attributes:
      log_temperature: logarithm of the temperature alpha, shape ().
      temperature_opt: of its optimizer.
    """

    log_temperature: Array
    temperature_opt: PyTree


S = TypeVar("S", bound=SoftState)


def start_temperature(actor: Actor[AnyPolicyConfig], alpha: float, learning_rate: float) -> tuple[Array, PyTree]:
    """``log_temperature`` and ``temperature_opt`` of a run that has not begun."""
    log_temperature = jnp.log(jnp.full((), alpha))
    return log_temperature, actor.optimizer(learning_rate).init(log_temperature)


def normalized_entropy(entropy: Array, target: float) -> Array:
    """(entropy + |target|) / (2 |target|): 0 at a negative target, 1 at minus the target. Gradient: exact.

    Source: Xing, Luk and Oh 2025 (SAPO), entropy normalisation: offset, then scale.
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

    Source: Haarnoja et al. 2018, "Soft Actor-Critic Algorithms and Applications", section "Automating Entropy
      Adjustment for Maximum Entropy RL", times |target|.
    """
    return jnp.exp(log_temperature) * abs(target) * (jax.lax.stop_gradient(entropy) - target)


def update_temperature(
    actor: Actor[AnyPolicyConfig], state: S, entropy: Array, *, target: float, learning_rate: float
) -> tuple[S, Metrics]:
    """One step towards the target entropy; the gradient of a loss that is not finite counts as zero.

    Args:
      actor: whose optimizer is used.
      state: what is updated.
      entropy: mean over the data, shape ().
      target: of the entropy.
      learning_rate: constant.

    Returns:
      The state, and the metric ``temperature``.
    """
    grad = jax.grad(temperature_loss)(state.log_temperature, entropy, target)
    log_temperature, opt = actor.update(learning_rate, grad, state.temperature_opt, state.log_temperature)
    new = state.replace(log_temperature=log_temperature, temperature_opt=opt)
    return new, {"temperature": jnp.exp(log_temperature)}
