"""What first-order actor-critic algorithms share: state of a run, actor's ascent, critics' targets."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from rewax import struct
from rewax.agents.actor_critic import Actor, ActorCritic
from rewax.agents.base import Metrics
from rewax.agents.gradients import Loss, mean_gradient, per_env_gradients
from rewax.agents.optimizers import apply
from rewax.agents.returns import short_horizon_return, td_lambda
from rewax.agents.rollout import Transition
from rewax.agents.run_state import PolicyState, fields, first_observation, run_keys, start_policy
from rewax.agents.value_fitting import fit_values
from rewax.envs.base import State
from rewax.envs.leaves import EnvLeaves
from rewax.types import Array, Key, PyTree


@struct.dataclass
class FirstOrderState(PolicyState):
    """Everything a run of an actor and critics is.

    Attributes:
      critic_params, critic_opt: of the critics and their optimizer.
      target_params: of the critics' target network, which moves slowly; None: there is none.
    """

    critic_params: PyTree
    critic_opt: PyTree
    target_params: PyTree


class Stretch(NamedTuple):
    """One environment's rollout, with the value of every next observation by every critic, (T, num_critics)."""

    state: State
    transitions: Transition
    next_values: Array


def start_actor_critic(networks: ActorCritic, leaves: EnvLeaves, key: Key) -> FirstOrderState:
    """The state of a run that has not begun."""
    keys = run_keys(key)
    base = start_policy(networks, leaves, keys)
    critic_params = networks.critics.init(keys.critics, first_observation(base))
    return FirstOrderState(
        **fields(base),
        critic_params=critic_params,
        critic_opt=networks.critic_optimizer.init(critic_params),
        target_params=critic_params if networks.config.target_decay is not None else None,
    )


def stretch_loss(
    networks: ActorCritic, state: FirstOrderState, end: State, transitions: Transition, reward: Array
) -> tuple[Array, Stretch]:
    """Minus the return per step of one environment's rollout: rewards, and values where a stretch ends.

    Args:
      networks, state: the critics, and the statistics of what they see.
      end: state after the rollout.
      transitions: of the rollout.
      reward: of each step, with or without a bonus, shape (T,).

    Gradient: through rewards and observations; the critics' parameters are constants of the actor's loss.
    """
    t, config = transitions, networks.config
    next_values = networks.values(state.critic_params, networks.seen(state.environments.statistics, t.next_obs))
    value = jnp.where(t.terminated, 0.0, combined(next_values, config.actor_value))
    objective = short_horizon_return(reward, value, t.done, t.valid, discount=config.discount)
    return -objective / jnp.sum(t.active), Stretch(end, t, next_values)


def actor_update(actor: Actor, state: PolicyState, loss: Loss, key: Key) -> tuple[dict[str, PyTree], Any, Metrics]:
    """One step of the actor along the mean of the environments' finite gradients.

    Args:
      actor, state: what is updated; the configuration is a ``GradientConfig`` too.
      loss: of one environment.
      key: split into one per environment.

    Returns:
      The fields of the state that change, ``actor_params`` and ``actor_opt``; the loss's data (leading axis of
      environments); and the metrics ``actor_loss``, ``actor_grad_norm`` and ``dropped_gradients``.
    """
    losses, data, grads = per_env_gradients(loss, state.actor_params, state.common(), state.environments, key)
    changes, metrics = actor_step(actor, state, losses, grads)
    return changes, data, metrics


def actor_step(actor: Actor, state: PolicyState, losses: Array, grads: PyTree) -> tuple[dict[str, PyTree], Metrics]:
    """The same from the environments' losses and gradients."""
    grad, metrics = mean_gradient(losses, grads, max_norm=actor.config.max_env_grad_norm)
    params, opt = apply(actor.actor_optimizer, grad, state.actor_opt, state.actor_params)
    return {"actor_params": params, "actor_opt": opt}, metrics


def combined(values: Array, how: str) -> Array:
    """One value from those of several critics, by their ``mean`` or ``min``. Gradient: exact."""
    return values.mean(axis=-1) if how == "mean" else values.min(axis=-1)


def critic_update(networks: ActorCritic, state: FirstOrderState, data: Stretch, reward: Array) -> tuple[dict, Metrics]:
    """Regress all critics onto TD(lambda) targets; the target network follows.

    Args:
      networks, state: what is fitted.
      data: rollouts, leading axis of environments.
      reward: of each step, with or without a bonus, shape (num_envs, T).

    Returns:
      The fields of the state that change, ``critic_params``, ``critic_opt`` and ``target_params``; and metrics.
    """
    t, config, statistics = data.transitions, networks.config, state.environments.statistics
    next_values = data.next_values
    if state.target_params is not None:
        seen = networks.seen(statistics, t.next_obs)
        next_values = jax.vmap(lambda obs: networks.values(state.target_params, obs))(seen)
    value = jnp.where(t.terminated, 0.0, combined(next_values, config.target_value))
    targets = jax.vmap(lambda *steps: td_lambda(*steps, discount=config.discount, lambda_=config.td_lambda))(
        reward, value, t.done, t.valid
    )
    params, opt, metrics = fit_values(
        networks.values,
        state.critic_params,
        state.critic_opt,
        networks.critic_optimizer,
        networks.seen(statistics, t.obs),
        targets,
        t.valid,
        passes=config.critic_passes,
        minibatches=config.critic_minibatches,
        chunk=networks.critic_chunk,
    )
    target = state.target_params
    if target is not None:
        target = optax.incremental_update(params, target, 1.0 - config.target_decay)
    changes = {"critic_params": params, "critic_opt": opt, "target_params": target}
    return changes, {**metrics, "value": jnp.mean(value, where=t.valid)}
