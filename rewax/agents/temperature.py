"""The temperature, the weight of the entropy: its loss and its update."""

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
    """The state of an algorithm with critics and a temperature.

    Attributes:
      log_temperature: logarithm of the temperature alpha, shape ().
      temperature_opt: state of its optimizer.
    """

    log_temperature: Array
    temperature_opt: PyTree


S = TypeVar("S", bound=SoftState)


def start_temperature(actor: Actor[AnyPolicyConfig], alpha: float, learning_rate: float) -> tuple[Array, PyTree]:
    """Initial ``log_temperature`` and ``temperature_opt``."""
    log_temperature = jnp.log(jnp.full((), alpha))
    return log_temperature, actor.optimizer(learning_rate).init(log_temperature)


def normalized_entropy(entropy: Array, target: float) -> Array:
    """(entropy + |target|) / (2 |target|). For a negative target: 0 at the target, 1 at minus it. Gradient: exact.

    Source: Xing, Luk and Oh 2025 (SAPO), entropy normalisation: offset, then scale.
    """
    size = abs(target)
    return (entropy + size) * (0.5 / size)


def temperature_loss(log_temperature: Array, entropy: Array, target: float) -> Array:
    """exp(log_temperature) |target| (entropy - target).

    Descent raises the temperature while the entropy is below the target. The factor |target| compensates the scale of
    ``normalized_entropy``.

    Args:
      log_temperature: shape ().
      entropy: mean entropy over the data, shape (). Gradient: none.
      target: target entropy.

    Source: Haarnoja et al. 2018, "Soft Actor-Critic Algorithms and Applications", section "Automating Entropy
      Adjustment for Maximum Entropy RL", times |target|.
    """
    return jnp.exp(log_temperature) * abs(target) * (jax.lax.stop_gradient(entropy) - target)


def update_temperature(
    actor: Actor[AnyPolicyConfig], state: S, entropy: Array, *, target: float, learning_rate: float
) -> tuple[S, Metrics]:
    """One step of the temperature towards the target entropy. A non-finite gradient is replaced by zero.

    Args:
      actor: gives the optimizer.
      state: the run.
      entropy: mean entropy over the data, shape ().
      target: target entropy.
      learning_rate: constant learning rate.

    Returns:
      The new state, and the metric ``temperature``.
    """
    grad = jax.grad(temperature_loss)(state.log_temperature, entropy, target)
    log_temperature, opt = actor.update(learning_rate, grad, state.temperature_opt, state.log_temperature)
    new = state.replace(log_temperature=log_temperature, temperature_opt=opt)
    return new, {"temperature": jnp.exp(log_temperature)}
