"""What first-order actor-critic algorithms share: state of a run, actor's ascent, critics' targets."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from rewax import struct
from rewax.agents.actor_critic import ActorCritic
from rewax.agents.base import Metrics
from rewax.agents.environments import Environments, start_environments
from rewax.agents.gradients import Loss, mean_of_finite, per_env_gradients
from rewax.agents.optimizers import apply
from rewax.agents.returns import short_horizon_return, td_lambda
from rewax.agents.rollout import Transition
from rewax.agents.value_fitting import fit_values
from rewax.envs.base import State
from rewax.envs.leaves import EnvLeaves
from rewax.types import Array, Key, PyTree


@struct.dataclass
class FirstOrderState(struct.Replaceable):
    """Everything a run is; a checkpoint holds just this.

    Attributes:
      actor_params, critic_params: of the networks.
      actor_opt, critic_opt: of the optimizers.
      environments: the environments, with the statistics of their observations.
      key: source of randomness.
      iteration, env_steps: done so far, shape (), int32.
    """

    actor_params: PyTree
    critic_params: PyTree
    actor_opt: PyTree
    critic_opt: PyTree
    environments: Environments
    key: Key
    iteration: Array
    env_steps: Array


class Stretch(NamedTuple):
    """One environment's rollout, with the value of every next observation by every critic, (T, num_critics)."""

    state: State
    transitions: Transition
    next_values: Array


def start_run(networks: ActorCritic, leaves: EnvLeaves, key: Key) -> FirstOrderState:
    """The state of a run that has not begun."""
    config = networks.config
    key, actor_key, critic_key, env_key, stagger_key = jax.random.split(key, 5)
    environments = start_environments(
        leaves,
        env_key,
        stagger_key,
        num_envs=config.num_envs,
        stagger=config.stagger_episodes,
        learn_statistics=config.normalize_observations,
    )
    obs = jax.tree.map(lambda a: a[0], environments.state.obs)
    actor_params, critic_params = networks.actor.init(actor_key, obs), networks.critics.init(critic_key, obs)
    return FirstOrderState(
        actor_params=actor_params,
        critic_params=critic_params,
        actor_opt=networks.actor_optimizer.init(actor_params),
        critic_opt=networks.critic_optimizer.init(critic_params),
        environments=environments,
        key=key,
        iteration=jnp.zeros((), jnp.int32),
        env_steps=jnp.zeros((), jnp.int32),
    )


def fields(state: Any) -> dict[str, Any]:
    """The fields of a state by name, to build one of a subclass from."""
    return {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}


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
    value = jnp.where(t.terminated, 0.0, next_values.mean(axis=-1))
    objective = short_horizon_return(reward, value, t.done, t.valid, discount=config.discount)
    return -objective / config.horizon, Stretch(end, t, next_values)


def actor_update(
    networks: ActorCritic, state: FirstOrderState, loss: Loss, key: Key
) -> tuple[PyTree, PyTree, Stretch, Metrics]:
    """One step of the actor along the mean of the environments' finite gradients.

    Returns:
      Parameters, optimizer state, the rollouts (leading axis of environments), and the metrics ``actor_loss``,
      ``actor_grad_norm`` and ``dropped_gradients``.
    """
    losses, data, grads = per_env_gradients(loss, state.actor_params, state.environments, key)
    grad, kept = mean_of_finite(losses, grads)
    params, opt = apply(networks.actor_optimizer, grad, state.actor_opt, state.actor_params)
    metrics = {
        "actor_loss": jnp.sum(jnp.where(kept, losses, 0.0)) / jnp.maximum(kept.sum(), 1),
        "actor_grad_norm": optax.tree.norm(grad),
        "dropped_gradients": jnp.sum(~kept),
    }
    return params, opt, data, metrics


def critic_update(
    networks: ActorCritic, state: FirstOrderState, data: Stretch, reward: Array
) -> tuple[PyTree, PyTree, Metrics]:
    """Regress all critics onto TD(lambda) targets of the smaller value.

    Args:
      networks, state: what is fitted.
      data: rollouts, leading axis of environments.
      reward: of each step, with or without a bonus, shape (num_envs, T).
    """
    t, config = data.transitions, networks.config
    value = jnp.where(t.terminated, 0.0, data.next_values.min(axis=-1))
    targets = jax.vmap(lambda *steps: td_lambda(*steps, discount=config.discount, lambda_=config.td_lambda))(
        reward, value, t.done, t.valid
    )
    params, opt, metrics = fit_values(
        networks.values,
        state.critic_params,
        state.critic_opt,
        networks.critic_optimizer,
        networks.seen(state.environments.statistics, t.obs),
        targets,
        t.valid,
        passes=config.critic_passes,
        minibatches=config.critic_minibatches,
        chunk=networks.critic_chunk,
    )
    return params, opt, {**metrics, "value": jnp.mean(value, where=t.valid)}


def advanced(networks: ActorCritic, state: FirstOrderState, data: Stretch, **changes: Any) -> Any:
    """The state after an iteration: environments moved on, counters raised, and what ``changes`` names."""
    config = networks.config
    environments = state.environments.advanced(
        data.state, data.transitions, learn_statistics=config.normalize_observations
    )
    steps = config.num_envs * config.horizon
    return state.replace(
        environments=environments, iteration=state.iteration + 1, env_steps=state.env_steps + steps, **changes
    )
