"""SAPO whose actor weights the steps of a rollout by the inverse variance of their gradients.

The action of step t has the gradient of everything after it in the rollout, through H - t steps of the simulation: that
of an early step is far noisier than that of a late one. Where environments begin a rollout anywhere in their episodes,
every step estimates the same gradient of the policy, times discount^t. Of all weighted sums with that expectation, the
one with weights proportional to discount^t / variance_t has the least variance, if steps are uncorrelated.

Source: the idea of per-step inverse-variance weights for first-order gradients is that of IVW-H in Onoda, Parmas,
Yaguchi and Matsuo 2026, "Does 'Do Differentiable Simulators Give Better Policy Gradients?' Give Better Policy
Gradients?" (arXiv 2604.18161), of which only the abstract was at hand. The estimator is our own:

- It weights the steps of a first-order gradient; there is no zeroth-order estimate beside it.
- The variance is that of the gradient with respect to the step's action, over environments, summed over components. The
  variance of the policy's parameters would take a gradient of theirs for each step.
- Weights come from earlier iterations, so they do not depend on the gradients that they weight and add no bias.
- The estimate leans on late steps, hence on the critics' gradient, whose errors are a bias that no variance shows.
- A discount that starts anew within a rollout, where an episode ends, does not change the weights.
"""

import dataclasses
import functools
from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.agents import sapo
from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.first_order import Rollout, actor_step, rollout_loss, start_actor_critic
from rewax.agents.gradients import Loss, per_env_gradients
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class IVWConfig(SAPOConfig):
    """Hyper-parameters beyond SAPO's.

    Attributes:
      variance_decay: share that the running mean of the variances keeps each iteration.
      variance_floor: a variance below this share of their mean counts as that share: it bounds the weights.
    """

    variance_decay: Share = 0.9
    variance_floor: Positive = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        check_entropy_of_steps(self)


def check_entropy_of_steps(config: SAPOConfig) -> None:
    """Raises ValueError where the loss has a term of the entropy that is none of a step's return."""
    if not config.entropy_in_return and config.entropy_in_loss:
        raise ValueError("entropy_in_loss is True without entropy_in_return: give False, steps have no such term")


C = TypeVar("C", bound=SAPOConfig)
Networks: TypeAlias = ActorCritic[IVWConfig]


@struct.dataclass
class IVWState(SoftState):
    """Everything a run is; a checkpoint holds just this.

    Attributes:
      variance: running mean of ``step_variance``; discount^t, which gives equal weights, before the first iteration.
    """

    variance: Array


def make_ivw(env: Env, config: IVWConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """SAPO with weighted steps; arguments as for ``rewax.agents.actor_critic.actor_agent``."""
    config = IVWConfig() if config is None else config
    return actor_agent("sapo_ivw", env, config, init=start, train_step=train_step, randomize=randomize)


def start(config: SAPOConfig, leaves: EnvLeaves, key: Key) -> IVWState:
    """The state of a run that has not begun."""
    networks = make_actor_critic(leaves.first(), config)
    log_alpha, opt = start_temperature(networks, config.initial_temperature, config.temperature_learning_rate)
    own = {"log_temperature": log_alpha, "temperature_opt": opt, "variance": discounts(config)}
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
    """``first_order.actor_update`` that also measures the variance of the gradient of each step.

    Args:
      networks, state, key: as there.
      loss: of one environment; its parameters are the actor's, and zeros that it adds to the actions, shape
        (horizon, action_size), whose gradient is that of the steps.
      decay: share that the running mean of the variances keeps.
    """
    config = networks.config
    params = (state.actor_params, jnp.zeros((config.horizon, networks.action_size)))
    losses, rollouts, (grads, nudges) = per_env_gradients(loss, params, state.common(), state.environments, key)
    state, metrics = actor_step(networks, state, losses, grads, max_norm=config.max_env_grad_norm)
    variance = running_variance(state, nudges, decay)
    return state.replace(variance=variance), metrics, rollouts


def actor_loss(
    params: tuple[PyTree, Array], common: IVWState, env: AutoReset, env_state: State, key: Key, *, networks: Networks
) -> tuple[Array, Rollout]:
    """Minus the soft return per step of one environment's rollout.

    Args:
      params: of the actor; and zeros that are added to the actions, shape (horizon, action_size).

    Gradient: through the simulation; of the actor's parameters each step's share times its weight.
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


def running_variance(state: IVWState, gradients: Array, decay: float) -> Array:
    """The running mean with the variances of an iteration, which is the first to count; see ``step_variance``."""
    measured = step_variance(gradients)
    kept = jnp.where(state.iteration == 0, 0.0, decay)
    return jnp.where(jnp.isfinite(measured), kept * state.variance + (1.0 - kept) * measured, state.variance)


def step_variance(gradients: Array) -> Array:
    """Variance over environments of each step's gradient, summed over the action's components, shape (T,).

    Args:
      gradients: with respect to the actions, shape (num_envs, T, action_size). An environment whose gradient is not
        finite is left out.
    """
    kept = jax.vmap(all_finite)(gradients)[:, None, None]
    count = jnp.maximum(kept.sum(), 1)
    gradients = jnp.where(kept, gradients, 0.0)
    mean = gradients.sum(axis=0) / count
    return jnp.sum(jnp.where(kept, gradients - mean, 0.0) ** 2, axis=(0, 2)) / jnp.maximum(count - 1, 1)


def step_weights(config: IVWConfig, variance: Array) -> Array:
    """Weights of least variance, shape (T,). Their sum over discount^t is that of equal weights, 1 each.

    Args:
      config: the discount and the floor.
      variance: of each step's discounted gradient, shape (T,). If all are zero, the weights are equal.
    """
    mean = variance.mean()
    floored = jnp.maximum(variance, config.variance_floor * jnp.where(mean > 0, mean, 1.0))
    discount = discounts(config)
    weights = jnp.where(mean > 0, discount / floored, 1.0)
    return weights * jnp.sum(discount) / jnp.sum(weights * discount)


def discounts(config: SAPOConfig) -> Array:
    """discount^t of each step of a rollout, shape (T,)."""
    return config.discount ** jnp.arange(config.horizon, dtype=jnp.float32)
