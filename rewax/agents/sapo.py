"""SAPO, soft analytic policy optimization: maximum-entropy first-order reinforcement learning.

One iteration: every environment acts for a short horizon; the soft return of that stretch plus the soft value at its
end is differentiated through the simulation into the actor; temperature and critics follow.

Source: Xing, Luk and Oh 2025, "Stabilizing Reinforcement Learning in Differentiable Multiphysics Simulation"
(ICLR 2025), with these corrections of its code: the bootstrap is V(s_{t+1}) always, a reset cuts the gradient of its
own environment only, the gradient norm is clipped over everything an optimizer updates, an environment whose gradient
is not finite is left out and counted, and a step that failed numerically is masked instead of rewarded with 0.
"""

import dataclasses

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.agents.actor_critic import ActorCritic, make_actor_critic
from rewax.agents.base import Agent, Metrics, bind
from rewax.agents.config import ActorCriticConfig, check_positive
from rewax.agents.environments import taken_apart
from rewax.agents.episodes import episode_metrics
from rewax.agents.first_order import (
    FirstOrderState,
    Stretch,
    actor_update,
    advanced,
    critic_update,
    fields,
    start_run,
    stretch_loss,
)
from rewax.agents.rollout import rollout
from rewax.agents.temperature import normalized_entropy, update_temperature
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, Observation, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class SAPOConfig(ActorCriticConfig):
    """Hyper-parameters beyond those of ``ActorCriticConfig``; the defaults are the paper's for the deformable tasks.

    Attributes:
      initial_temperature: alpha at the start; fixed at it if ``learn_temperature`` is off.
      learn_temperature: adapt alpha to the target entropy.
      temperature_learning_rate: of AdamW on the logarithm of the temperature, constant.
      target_entropy_scale: the target entropy is minus this times the number of action components.
      entropy_in_return, entropy_in_targets: the two places of the entropy bonus (the paper's ablations).
    """

    initial_temperature: float = 1.0
    learn_temperature: bool = True
    temperature_learning_rate: float = 5e-3
    target_entropy_scale: float = 0.5
    entropy_in_return: bool = True
    entropy_in_targets: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("initial_temperature", "temperature_learning_rate", "target_entropy_scale"):
            check_positive(name, getattr(self, name))


@struct.dataclass
class SAPOState(FirstOrderState):
    """Everything a run is; a checkpoint holds just this."""

    log_temperature: Array
    temperature_opt: PyTree


def make_sapo(env: Env, config: SAPOConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """SAPO on an environment.

    Args:
      env: one environment, without auto-reset; or a batch of ``num_envs`` of them, see ``rewax.envs.stack``.
      config: hyper-parameters.
      randomize: ``(key, env) -> env``: draws leaves of the environment anew at each reset.

    Returns:
      ``init(key)``, ``train_step(state)`` and ``policy(state, obs, key, deterministic=False)``.
    """
    config = SAPOConfig() if config is None else config
    leaves = taken_apart(env, config.num_envs, randomize)
    networks = make_actor_critic(leaves.first(), config)

    def policy(state: SAPOState, obs: Observation, key: Key, deterministic: bool = False) -> Array:
        distribution = networks.action_distribution(state.actor_params, state.environments.statistics, obs)
        return distribution.mode() if deterministic else distribution.sample(key)

    return bind("sapo", config, leaves, init=init, train_step=train_step, policy=policy)


def init(config: SAPOConfig, leaves: EnvLeaves, key: Key) -> SAPOState:
    """The state of a run that has not begun."""
    networks = make_actor_critic(leaves.first(), config)
    log_temperature = jnp.log(jnp.full((), config.initial_temperature))
    temperature_opt = networks.optimizer(config.temperature_learning_rate).init(log_temperature)
    base = fields(start_run(networks, leaves, key))
    return SAPOState(**base, log_temperature=log_temperature, temperature_opt=temperature_opt)


def train_step(config: SAPOConfig, state: SAPOState) -> tuple[SAPOState, Metrics]:
    """One iteration: actor, temperature, critics."""
    networks = make_actor_critic(state.environments.env.first(), config)
    key, rollout_key = jax.random.split(state.key)

    def loss(actor_params: PyTree, env: AutoReset, env_state: State, key: Key) -> tuple[Array, Stretch]:
        return actor_loss(networks, state, actor_params, env, env_state, key)

    actor_params, actor_opt, data, actor_metrics = actor_update(networks, state, loss, rollout_key)

    entropy, valid = data.transitions.extras["entropy"], data.transitions.valid
    mean_entropy = jnp.mean(entropy, where=valid)
    log_temperature, temperature_opt = state.log_temperature, state.temperature_opt
    if config.learn_temperature:
        optimizer = networks.optimizer(config.temperature_learning_rate)
        log_temperature, temperature_opt = update_temperature(
            log_temperature, mean_entropy, target_entropy(networks), optimizer, temperature_opt
        )

    reward = data.transitions.reward
    if config.entropy_in_targets:
        reward = reward + jnp.exp(log_temperature) * normalized_entropy(entropy, target_entropy(networks))
    critic_params, critic_opt, critic_metrics = critic_update(networks, state, data, reward)

    new = advanced(
        networks,
        state,
        data,
        actor_params=actor_params,
        critic_params=critic_params,
        log_temperature=log_temperature,
        actor_opt=actor_opt,
        critic_opt=critic_opt,
        temperature_opt=temperature_opt,
        key=key,
    )
    own = {"entropy": mean_entropy, "temperature": jnp.exp(log_temperature)}
    episodes = episode_metrics(state.environments, data.transitions)
    return new, {**episodes, **own, **actor_metrics, **critic_metrics}


def target_entropy(networks: ActorCritic) -> float:
    """What the temperature steers to: minus half the number of action components in the paper."""
    return -networks.config.target_entropy_scale * networks.action_size


def actor_loss(
    networks: ActorCritic, state: SAPOState, actor_params: PyTree, env: AutoReset, env_state: State, key: Key
) -> tuple[Array, Stretch]:
    """Minus the soft return per step of one environment's stretch. Gradient: through the simulation."""
    config, statistics = networks.config, state.environments.statistics

    def policy(obs: Observation, key: Key) -> tuple[Array, dict[str, Array]]:
        distribution = networks.action_distribution(actor_params, statistics, obs)
        action_key, entropy_key = jax.random.split(key)
        # A fresh sample, independent of the action that is taken.
        _, log_prob = distribution.sample_and_log_prob(entropy_key)
        return distribution.sample(action_key), {"entropy": -log_prob}

    end, transitions = rollout(env, env_state, policy, key, horizon=config.horizon, differentiate=config.differentiate)
    reward = transitions.reward
    if config.entropy_in_return:
        bonus = normalized_entropy(transitions.extras["entropy"], target_entropy(networks))
        reward = reward + jnp.exp(state.log_temperature) * bonus
    return stretch_loss(networks, state, end, transitions, reward)
