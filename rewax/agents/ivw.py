"""SAPO with inverse-variance weights: the actor weights the steps of a rollout by the inverse variance of gradients.

The gradient with respect to the action of step t flows through H - t steps of the simulation, so early steps have far
noisier gradients than late ones. If environments begin rollouts at random times of their episodes, every step gives an
estimate of the same policy gradient, times discount^t. Among the weighted sums with the same expectation, weights
proportional to discount^t / variance_t give the least variance, if steps are uncorrelated.

Source: the idea of per-step inverse-variance weights for first-order gradients is that of IVW-H in Onoda, Parmas,
Yaguchi and Matsuo 2026, "Does 'Do Differentiable Simulators Give Better Policy Gradients?' Give Better Policy
Gradients?" (arXiv 2604.18161). Only its abstract was used; the estimator is our own:

- It weights the steps of a first-order gradient. There is no zeroth-order estimate.
- The variance is that of the gradient with respect to the step's action, taken over environments and summed over
  components. The variance with respect to the policy's parameters would need a parameter gradient for each step.
- Weights come from earlier iterations. They are independent of the gradients that they weight, so they add no bias.
- Late steps get large weights, so the estimate depends more on the critics' gradient. Errors of the critics are a bias
  that the variance does not show.
- The discount restarts where an episode ends within a rollout. The weights ignore this.
"""

import dataclasses
import functools
from typing import ClassVar, TypeAlias, TypeVar

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.agents import sapo
from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import no_memory
from rewax.agents.first_order import Rollout, actor_step, rollout_loss, start_actor_critic
from rewax.agents.gradients import Loss, clip_scale, finite_per_env, per_env_gradients, scaled_per_env
from rewax.agents.legal import Positive, Share
from rewax.agents.rollout import rollout, scale_gradient
from rewax.agents.sapo import SAPOConfig
from rewax.agents.temperature import SoftState, start_temperature
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.status import all_finite
from rewax.types import Array, Key, Observation, PyTree

_MOST_GROWTH = 10.0
"""Largest ratio of an iteration's variance to the running mean that the running mean takes in."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class IVWConfig(SAPOConfig):
    """Hyper-parameters beyond SAPO's.

    Attributes:
      variance_decay: decay of the running mean of the variances per iteration.
      variance_floor: lower bound of a variance, as a share of the mean variance; it bounds the weights.
    """

    extends: ClassVar[str] = "sapo_ivw"
    variance_decay: Share = 0.9
    variance_floor: Positive = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        no_memory("the weights of steps assume that a step's action is all that it does").check("memory", self.memory)
        check_measurable(self)


def check_measurable(config: SAPOConfig) -> None:
    """Raises ValueError if gradients of steps have no variance, or the loss has a term that belongs to no step."""
    if config.num_envs < 2:
        raise ValueError(
            f"num_envs is {config.num_envs}: give at least 2, because the variance is that over environments"
        )
    if not config.entropy_in_return and config.entropy_in_loss:
        raise ValueError(
            "entropy_in_loss is True without entropy_in_return: give False, because the term belongs to no single step"
        )


C = TypeVar("C", bound=SAPOConfig)
Networks: TypeAlias = ActorCritic[IVWConfig]


@struct.dataclass
class IVWState(SoftState):
    """The complete state of a run; this is what a checkpoint stores.

    Attributes:
      variance: running mean of ``step_variance``, shape (T,). It starts as 0, which gives equal weights.
    """

    variance: Array


def make_ivw(env: Env, config: IVWConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """SAPO with weighted steps; arguments as for ``rewax.agents.actor_critic.actor_agent``."""
    config = IVWConfig.given(config)
    return actor_agent("sapo_ivw", env, config, init=start, train_step=train_step, randomize=randomize)


def start(config: SAPOConfig, leaves: EnvLeaves, key: Key) -> IVWState:
    """The first state of a run."""
    networks = make_actor_critic(leaves.first(), config)
    log_alpha, opt = start_temperature(networks, config.initial_temperature, config.temperature_learning_rate)
    own = {"log_temperature": log_alpha, "temperature_opt": opt, "variance": jnp.zeros(config.horizon)}
    return start_actor_critic(IVWState, networks, leaves, key, **own)


def train_step(config: IVWConfig, state: IVWState) -> tuple[IVWState, Metrics]:
    """One iteration: actor, variances, temperature, critics."""
    networks = make_actor_critic(state.environments.env.first(), config)
    key, rollout_key = jax.random.split(state.key)
    weights = step_weights(config, state.variance)
    own = {"least_step_weight": weights.min(), "largest_step_weight": weights.max()}
    loss = functools.partial(actor_loss, networks=networks)

    decay = config.variance_decay
    state, actor_metrics, rollouts = measured_actor_update(networks, state, loss, rollout_key, decay=decay)
    state, metrics = sapo.after_actor(networks, state, rollouts, key)
    return state, {**metrics, **own, **actor_metrics}


def measured_actor_update(
    networks: ActorCritic[C], state: IVWState, loss: Loss[IVWState, Rollout], key: Key, *, decay: float
) -> tuple[IVWState, Metrics, Rollout]:
    """``first_order.actor_update`` that also measures the variance of each step's gradient.

    Environments whose gradient the actor leaves out do not count in the variance either.

    Args:
      networks, state, key: see ``first_order.actor_update``.
      loss: loss of one environment. Its parameters are the actor's, and zeros of shape (horizon, action_size) that it
        adds to the actions; the gradient with respect to the zeros is that of the actions.
      decay: decay of the running mean of the variances.
    """
    config = networks.config
    params = (state.actor_params, jnp.zeros((config.horizon, networks.action_size)))
    losses, rollouts, (grads, nudges) = per_env_gradients(loss, params, state.common(), state.environments, key)
    state, metrics = actor_step(networks, state, losses, grads, max_norm=config.max_env_grad_norm)
    if config.max_env_grad_norm is not None:  # the variance of the gradients that the actor follows
        nudges = scaled_per_env(nudges, clip_scale(grads, config.max_env_grad_norm))
    variance = running_variance(state, nudges, finite_per_env(losses, grads), decay)
    return state.replace(variance=variance), metrics, rollouts


def actor_loss(
    params: tuple[PyTree, Array], common: IVWState, env: AutoReset, env_state: State, key: Key, *, networks: Networks
) -> tuple[Array, Rollout]:
    """Minus the soft return per step of one environment's rollout.

    Args:
      params: the actor's parameters, and zeros of shape (horizon, action_size) that are added to the actions.

    Gradient: through the simulation. Each step's contribution to the actor's gradient is multiplied by its weight.
    """
    (actor_params, nudges), config, statistics = params, networks.config, common.environments.statistics

    def policy(obs: Observation, key: Key, given: tuple[Array, Array]) -> tuple[Array, dict[str, Array]]:
        weight, nudge = given
        action, aux = sapo.soft_policy(networks, scale_gradient(actor_params, weight), statistics)(obs, key)
        return action + nudge, aux

    inputs = (step_weights(config, common.variance), nudges)
    end, t = rollout(env, env_state, policy, key, horizon=config.horizon, inputs=inputs, **config.gradient_flow)
    soft = sapo.bonus(networks, common.log_temperature, t.aux["entropy"]) if config.entropy_in_return else 0.0
    return rollout_loss(networks, common, end, t, t.reward + soft)


def running_variance(state: IVWState, gradients: Array, valid: Array, decay: float) -> Array:
    """The running mean updated with ``step_variance``, of which it takes at most ``_MOST_GROWTH`` times its own value.

    So one iteration with a chaotic environment is forgotten in a few others. The first iteration replaces the initial
    value, and so does the first with a variance above 0 of a step that had none.
    """
    new, old = step_variance(gradients, valid), state.variance
    kept = jnp.where((state.iteration == 0) | (old == 0), 0.0, decay)
    return kept * old + (1.0 - kept) * jnp.where(old > 0, jnp.minimum(new, _MOST_GROWTH * old), new)


def step_variance(gradients: Array, valid: Array) -> Array:
    """Variance over environments of each step's gradient, summed over the action's components, shape (T,).

    Args:
      gradients: gradients with respect to the actions, shape (num_envs, T, action_size). Environments with a
        non-finite gradient are left out.
      valid: mask of the environments that count, shape (num_envs,), bool.

    Returns:
      The variance, at most the square root of the largest float, so that ratios and sums of variances do not overflow.
      A variance that overflows counts as that.
    """
    kept = (valid & jax.vmap(all_finite)(gradients))[:, None, None]
    count = jnp.maximum(kept.sum(), 1)
    gradients = jnp.where(kept, gradients, 0.0)
    mean = gradients.sum(axis=0) / count
    variance = jnp.sum(jnp.where(kept, gradients - mean, 0.0) ** 2, axis=(0, 2)) / jnp.maximum(count - 1, 1)
    largest = jnp.sqrt(jnp.finfo(variance.dtype).max)
    return jnp.where(variance < largest, variance, largest)  # a comparison with NaN is false


def step_weights(config: IVWConfig, variance: Array) -> Array:
    """Weights that give the least variance, shape (T,).

    They are scaled such that sum(weights * discount^t) = sum(discount^t), as for weights of 1.

    Args:
      config: gives the discount and the floor.
      variance: variance of each step's discounted gradient, shape (T,). A step with variance 0 says nothing about
        its noise, as behind a latency, where the last actions have no effect within the rollout: it counts as a step
        with the mean variance of the others. If all are zero, all weights are 1.
    """
    discount = discounts(config)
    known = variance > 0
    mean = jnp.sum(variance) / jnp.maximum(jnp.sum(known), 1)
    floored = jnp.where(known, jnp.maximum(variance, config.variance_floor * mean), mean)
    weights = jnp.where(mean > 0, discount / jnp.where(mean > 0, floored, 1.0), 1.0)
    return weights * jnp.sum(discount) / jnp.sum(weights * discount)


def discounts(config: SAPOConfig) -> Array:
    """discount^t of each step of a rollout, shape (T,)."""
    return config.discount ** jnp.arange(config.horizon, dtype=float)
