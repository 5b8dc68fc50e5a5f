"""Parts of first-order actor-critic algorithms: the loss of a rollout, the updates of actor and critics."""

import functools
from collections.abc import Callable
from typing import NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import optax

from rewax.agents.actor_critic import Actor, ActorCritic
from rewax.agents.base import Metrics
from rewax.agents.config import AnyPolicyConfig, Combination, FirstOrderConfig
from rewax.agents.gradients import Loss, mean_gradient, per_env_gradients
from rewax.agents.legal import EnvLimit
from rewax.agents.optimizers import apply, schedule_at
from rewax.agents.returns import short_horizon_return, td_lambda
from rewax.agents.rollout import Transition
from rewax.agents.run_state import ActorCriticState, PolicyState, run_keys, start_environments
from rewax.agents.value_fitting import chunk_size, fit_values
from rewax.envs.base import State
from rewax.envs.leaves import EnvLeaves
from rewax.types import Array, Key, PyTree

A = TypeVar("A", bound=ActorCriticState)
S = TypeVar("S", bound=PolicyState)
D = TypeVar("D")
Networks: TypeAlias = ActorCritic[FirstOrderConfig]


class Rollout(NamedTuple):
    """One environment's rollout: final state, transitions, and all critics' values of next_obs, (T, num_critics)."""

    end: State
    transitions: Transition
    next_values: Array


def start_actor_critic(
    state_type: Callable[..., A], networks: Networks, leaves: EnvLeaves, key: Key, **own: PyTree
) -> A:
    """The first state of a run.

    Args:
      state_type: ``ActorCriticState``, or a subclass.
      networks: actor and critics.
      leaves: the environment's parameters.
      key: the run's key.
      own: values of the fields that the subclass adds.
    """
    keys = run_keys(key)
    environments = start_environments(networks.config, leaves, keys)
    actor_params = networks.network.init(keys.actor, environments.first_observation())
    critic_params = networks.critics.init(keys.critics, environments.first_observation())
    return state_type(
        environments=environments,
        key=keys.run,
        actor_params=actor_params,
        actor_opt=networks.actor_optimizer.init(actor_params),
        critic_params=critic_params,
        critic_opt=critic_optimizer(networks).init(critic_params),
        target_params=critic_params if networks.config.target_decay is not None else None,
        **own,
    )


def rollout_loss(
    networks: Networks, common: ActorCriticState, end: State, transitions: Transition, reward: Array
) -> tuple[Array, Rollout]:
    """Minus the return per step of one environment's rollout: rewards, plus values where segments end.

    Args:
      networks, common: the critics, and the observation statistics.
      end: state after the rollout.
      transitions: the rollout's transitions.
      reward: reward of each step, with or without an entropy bonus, shape (T,).

    Gradient: through rewards and observations. The critics' parameters are constants.
    """
    t, config = transitions, networks.config
    next_values = networks.values(common.critic_params, networks.normalize(common.environments.statistics, t.next_obs))
    value = jnp.where(t.terminated, 0.0, combined(next_values, config.actor_value))
    objective = short_horizon_return(reward, value, t.done, t.valid, discount=config.discount)
    return -objective / jnp.sum(t.active), Rollout(end, t, next_values)  # Xu et al. 2022 (SHAC), eq. 5


def actor_update(
    actor: Actor[AnyPolicyConfig], state: S, loss: Loss[S, D], key: Key, *, max_norm: EnvLimit
) -> tuple[S, Metrics, D]:
    """One step of the actor along the mean of the environments' finite gradients.

    Args:
      actor, state: the policy network with its optimizer, and the run.
      loss: loss of one environment, see ``per_env_gradients``.
      key: split into one key per environment.
      max_norm: limit of each environment's gradient before the mean; None: no clipping.

    Returns:
      The new state; the metrics ``actor_loss``, ``actor_grad_norm`` and ``dropped_gradients``; and the data of the
      loss, leading axis of environments.
    """
    losses, data, grads = per_env_gradients(loss, state.actor_params, state.common(), state.environments, key)
    return (*actor_step(actor, state, losses, grads, max_norm=max_norm), data)


def actor_step(
    actor: Actor[AnyPolicyConfig], state: S, losses: Array, grads: PyTree, *, max_norm: EnvLimit
) -> tuple[S, Metrics]:
    """``actor_update`` for losses and gradients that are given, leading axis of environments."""
    grad, metrics = mean_gradient(losses, grads, max_norm=max_norm)
    params, opt = apply(actor.actor_optimizer, grad, state.actor_opt, state.actor_params)
    return state.replace(actor_params=params, actor_opt=opt), metrics


def critic_update(networks: Networks, state: A, rollouts: Rollout, reward: Array) -> tuple[A, Metrics]:
    """Regress all critics onto TD(lambda) targets; the target network follows.

    Args:
      networks, state: the critics with their optimizer, and the run.
      rollouts: rollouts, leading axis of environments.
      reward: reward of each step, with or without an entropy bonus, shape (num_envs, T).

    Returns:
      The new state, and the metrics of ``fit_values`` and ``value``. Targets are constants.
    """
    t, config, statistics = rollouts.transitions, networks.config, state.environments.statistics
    next_values = rollouts.next_values
    if config.target_decay is not None:
        next_obs = networks.normalize(statistics, t.next_obs)
        next_values = jax.vmap(lambda obs: networks.values(state.target_params, obs))(next_obs)
    value = jnp.where(t.terminated, 0.0, combined(next_values, config.target_value))
    targets = jax.vmap(functools.partial(td_lambda, discount=config.discount, lambda_=config.td_lambda))(
        reward, value, t.done, t.valid
    )
    params, opt, metrics = fit_values(
        networks.values,
        state.critic_params,
        state.critic_opt,
        critic_optimizer(networks),
        networks.normalize(statistics, t.obs),
        targets,
        t.valid,
        passes=config.critic_passes,
        minibatches=config.critic_minibatches,
        chunk=critic_chunk(networks),
        divide=config.critic_division,
    )
    target = state.target_params
    if config.target_decay is not None:
        target = optax.incremental_update(params, target, 1.0 - config.target_decay)
    new = state.replace(critic_params=params, critic_opt=opt, target_params=target)
    return new, {**metrics, "value": jnp.mean(value, where=t.valid)}


def combined(values: Array, how: Combination) -> Array:
    """The ``mean`` or ``min`` over the critics' values, the last axis. Gradient: exact."""
    return values.mean(axis=-1) if how == "mean" else values.min(axis=-1)


def critic_optimizer(networks: Networks) -> optax.GradientTransformation:
    """The critics' optimizer for ``fit_values``. Its learning rate falls linearly over the iterations."""
    config = networks.config
    return networks.falling_optimizer(config.critic_learning_rate, config.critic_passes * config.critic_minibatches)


def at_iteration(config: FirstOrderConfig, state: A, iteration: Array) -> A:
    """The state with the learning rates of an iteration, whatever the number of iterations so far. All else stays."""
    passed = iteration * config.critic_passes * config.critic_minibatches
    return state.replace(
        actor_opt=schedule_at(state.actor_opt, iteration), critic_opt=schedule_at(state.critic_opt, passed)
    )


def critic_chunk(networks: Networks) -> int:
    """Number of samples that the critics differentiate at a time, a divisor of the minibatch."""
    config = networks.config
    if config.critic_chunk is not None:
        return config.critic_chunk
    return chunk_size(config.minibatch, networks.observation_spec)
