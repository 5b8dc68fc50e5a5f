"""Actor and critics as an algorithm uses them: functions of parameters, statistics and observations."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import optax

from rewax.agents.base import Agent, Init, TrainStep, bind
from rewax.agents.config import ActorCriticConfig, PolicyConfig
from rewax.agents.distributions import TanhNormal
from rewax.agents.environments import taken_apart
from rewax.agents.networks import ACTIVATIONS, Critics, Encoder, GaussianActor
from rewax.agents.normalization import RunningStatistics, normalize
from rewax.agents.optimizers import clipped_adamw, linear_fall
from rewax.agents.rollout import Policy
from rewax.agents.value_fitting import chunk_size
from rewax.envs.base import ArraySpec, Env
from rewax.envs.randomized import Randomize
from rewax.types import Array, Key, Observation, PyTree


@dataclasses.dataclass(frozen=True)
class Actor:
    """The policy network and its optimizer, as they follow from a configuration and the specs of an environment.

    Attributes:
      config: a ``PolicyConfig``: sizes and learning rates.
      network: flax module.
      action_size: components of an action.
      observation_spec: of the environment.
    """

    config: Any
    network: GaussianActor
    action_size: int
    observation_spec: dict[str, ArraySpec]

    def seen(self, statistics: RunningStatistics, obs: Observation) -> Observation:
        """Observations as the networks see them. Gradient: with respect to obs."""
        if not self.config.normalize_observations:
            return obs
        return normalize(statistics, obs, clip=self.config.observation_clip)

    def action_distribution(self, params: PyTree, statistics: RunningStatistics, obs: Observation) -> TanhNormal:
        """Of one environment's action. Gradient: exact, with respect to params and obs."""
        return self.distribution(params, self.seen(statistics, obs))

    def distribution(self, params: PyTree, seen: Observation) -> TanhNormal:
        """The same for an observation that ``seen`` returned."""
        out: Any = self.network.apply(params, seen)
        return TanhNormal(mean=out[0], log_std=out[1])

    def acting(self, params: PyTree, statistics: RunningStatistics) -> Policy:
        """A policy for ``rollout`` that samples its actions. Gradient: through the samples, into params and obs."""

        def policy(obs: Observation, key: Key) -> tuple[Array, dict[str, Array]]:
            return self.action_distribution(params, statistics, obs).sample(key), {}

        return policy

    def policy(self, state: Any, obs: Observation, key: Key, deterministic: bool = False) -> Array:
        """``Agent.policy`` of every algorithm whose state has ``actor_params`` and ``environments``."""
        distribution = self.action_distribution(state.actor_params, state.environments.statistics, obs)
        return distribution.mode() if deterministic else distribution.sample(key)

    @property
    def actor_optimizer(self) -> optax.GradientTransformation:
        """With a learning rate that falls, updated once per iteration."""
        return self.falling_optimizer(self.config.actor_learning_rate, 1)

    def optimizer(self, learning_rate: optax.ScalarOrSchedule) -> optax.GradientTransformation:
        """The configuration's Adam with another learning rate."""
        config = self.config
        return clipped_adamw(
            learning_rate,
            max_grad_norm=config.max_grad_norm,
            b1=config.adam_b1,
            b2=config.adam_b2,
            weight_decay=config.weight_decay if config.optimizer == "adamw" else 0.0,
        )

    def falling_optimizer(self, learning_rate: float, updates_per_iteration: int) -> optax.GradientTransformation:
        """The configuration's Adam with a learning rate that falls from this one."""
        return self.optimizer(
            linear_fall(
                learning_rate,
                self.config.final_learning_rate,
                self.config.num_iterations,
                updates_per_iteration=updates_per_iteration,
            )
        )


@dataclasses.dataclass(frozen=True)
class ActorCritic(Actor):
    """The critics too; ``config`` is an ``ActorCriticConfig``.

    Attributes:
      critics: flax module.
    """

    critics: Critics

    def values(self, params: PyTree, seen: Observation) -> Array:
        """By all critics, for observations with one leading axis that ``seen`` returned, shape (T, num_critics)."""
        out: Any = jax.vmap(lambda obs: self.critics.apply(params, obs))(seen)
        return out

    @property
    def critic_optimizer(self) -> optax.GradientTransformation:
        """With a learning rate that falls; for ``fit_values``."""
        return self.falling_optimizer(
            self.config.critic_learning_rate, self.config.critic_passes * self.config.critic_minibatches
        )

    @property
    def critic_chunk(self) -> int:
        """Samples that the critics differentiate at a time: a divisor of the minibatch."""
        chunk = self.config.critic_chunk
        return chunk_size(self.config.minibatch, self.observation_spec) if chunk is None else chunk


def make_actor(env: Env, config: PolicyConfig) -> Actor:
    """Policy network and optimizer for an environment, of which only the specs are used."""
    return Actor(config, _network(env, config), env.action_spec.shape[0], env.observation_spec)


def make_actor_critic(env: Env, config: ActorCriticConfig) -> ActorCritic:
    """Networks and optimizers for an environment, of which only the specs are used."""
    actor = make_actor(env, config)
    critics = Critics(
        _encoder(config), config.critic_widths, config.num_critics, ACTIVATIONS[config.activation], config.initial_gain
    )
    return ActorCritic(config, actor.network, actor.action_size, actor.observation_spec, critics)


def actor_agent(
    name: str,
    env: Env,
    config: Any,
    *,
    init: Init,
    train_step: TrainStep,
    networks: Callable[[Env, Any], Actor] = make_actor_critic,
    randomize: Randomize | None = None,
    donate: bool = False,
) -> Agent:
    """An agent with a policy network from pure functions of its configuration.

    Args:
      name: of the algorithm.
      env: one environment, without auto-reset; or a batch of ``num_envs`` of them, see ``rewax.envs.stack``.
      config: a ``PolicyConfig``.
      init, train_step, donate: as for ``bind``. Training states have ``actor_params`` and ``environments``.
      networks: ``(env, config) -> Actor``.
      randomize: ``(key, env) -> env``: draws leaves of the environment anew at each reset.
    """
    leaves = taken_apart(env, config.num_envs, randomize)
    policy = networks(leaves.first(), config).policy
    return bind(name, config, leaves, init=init, train_step=train_step, policy=policy, donate=donate)


def _encoder(config: PolicyConfig) -> Encoder:
    sizes = (config.point_widths, config.point_features, config.vector_features)
    return Encoder(*sizes, ACTIVATIONS[config.activation], config.initial_gain)


def _network(env: Env, config: PolicyConfig) -> GaussianActor:
    return GaussianActor(
        _encoder(config),
        config.actor_widths,
        env.action_spec.shape[0],
        ACTIVATIONS[config.activation],
        config.initial_gain,
        config.log_std_range,
        config.initial_log_std,
        config.state_dependent_std,
    )
