"""Actor and critics as an algorithm uses them: functions of parameters, statistics and observations."""

from typing import Any, NamedTuple

import jax
import optax

from rewax.agents.config import ActorCriticConfig
from rewax.agents.distributions import TanhNormal
from rewax.agents.networks import ACTIVATIONS, Critics, Encoder, GaussianActor
from rewax.agents.normalization import RunningStatistics, normalize
from rewax.agents.optimizers import clipped_adamw, linear_fall
from rewax.agents.value_fitting import chunk_size
from rewax.envs.base import ArraySpec, Env
from rewax.types import Array, Observation, PyTree


class ActorCritic(NamedTuple):
    """Networks and optimizers that follow from a configuration and the specs of an environment.

    Attributes:
      config: an ``ActorCriticConfig``: sizes and learning rates.
      actor, critics: flax modules.
      actor_optimizer, critic_optimizer: with learning rates that fall.
      action_size: components of an action.
      observation_spec: of the environment.
    """

    config: Any
    actor: GaussianActor
    critics: Critics
    actor_optimizer: optax.GradientTransformation
    critic_optimizer: optax.GradientTransformation
    action_size: int
    observation_spec: dict[str, ArraySpec]

    def seen(self, statistics: RunningStatistics, obs: Observation) -> Observation:
        """Observations as the networks see them. Gradient: with respect to obs."""
        if not self.config.normalize_observations:
            return obs
        return normalize(statistics, obs, clip=self.config.observation_clip)

    def action_distribution(self, params: PyTree, statistics: RunningStatistics, obs: Observation) -> TanhNormal:
        """Of one environment's action. Gradient: exact, with respect to params and obs."""
        out: Any = self.actor.apply(params, self.seen(statistics, obs))
        return TanhNormal(mean=out[0], log_std=out[1])

    def values(self, params: PyTree, seen: Observation) -> Array:
        """By all critics, for observations with one leading axis that ``seen`` returned, shape (T, num_critics)."""
        out: Any = jax.vmap(lambda obs: self.critics.apply(params, obs))(seen)
        return out

    @property
    def critic_chunk(self) -> int:
        """Samples that the critics differentiate at a time: a divisor of the minibatch."""
        chunk = self.config.critic_chunk
        return chunk_size(self.config.minibatch, self.observation_spec) if chunk is None else chunk

    def optimizer(self, learning_rate: optax.ScalarOrSchedule) -> optax.GradientTransformation:
        """The configuration's AdamW with another learning rate."""
        return _optimizer(self.config, learning_rate)


def make_actor_critic(env: Env, config: ActorCriticConfig) -> ActorCritic:
    """Networks and optimizers for an environment, of which only the specs are used."""
    activation, gain, action_size = ACTIVATIONS[config.activation], 1.0, env.action_spec.shape[0]

    def encoder() -> Encoder:
        return Encoder(config.point_widths, config.point_features, config.vector_features, activation, gain)

    def falling(learning_rate: float, updates: int) -> optax.GradientTransformation:
        schedule = linear_fall(
            learning_rate, config.final_learning_rate, config.num_iterations, updates_per_iteration=updates
        )
        return _optimizer(config, schedule)

    return ActorCritic(
        config=config,
        actor=GaussianActor(
            encoder(), config.actor_widths, action_size, activation, gain, config.log_std_range, config.initial_log_std
        ),
        critics=Critics(encoder(), config.critic_widths, config.num_critics, activation, gain),
        actor_optimizer=falling(config.actor_learning_rate, 1),
        critic_optimizer=falling(config.critic_learning_rate, config.critic_passes * config.critic_minibatches),
        action_size=action_size,
        observation_spec=env.observation_spec,
    )


def _optimizer(config: ActorCriticConfig, learning_rate: optax.ScalarOrSchedule) -> optax.GradientTransformation:
    return clipped_adamw(
        learning_rate,
        max_grad_norm=config.max_grad_norm,
        b1=config.adam_b1,
        b2=config.adam_b2,
        weight_decay=config.weight_decay,
    )
