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
from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import FirstOrderConfig, check_positive
from rewax.agents.episodes import episode_metrics
from rewax.agents.first_order import (
    FirstOrderState,
    Stretch,
    actor_update,
    critic_update,
    start_actor_critic,
    stretch_loss,
)
from rewax.agents.rollout import rollout
from rewax.agents.run_state import advanced, fields
from rewax.agents.temperature import normalized_entropy, update_temperature
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, Observation, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class SAPOConfig(FirstOrderConfig):
    """Hyper-parameters beyond those of ``FirstOrderConfig``; the defaults are the paper's for the deformable tasks.

    Attributes:
      initial_temperature: alpha at the start; fixed at it if ``learn_temperature`` is off.
      learn_temperature: adapt alpha to the target entropy.
      temperature_learning_rate: of Adam on the logarithm of the temperature, constant.
      target_entropy_scale: the target entropy is minus this times the number of action components.
      entropy_in_return, entropy_in_targets: the two places of the entropy bonus (the paper's ablations).
      normalize_entropy: the bonus is 0 at the target entropy and 1 at minus the target; else the entropy itself.
    """

    initial_temperature: float = 1.0
    learn_temperature: bool = True
    temperature_learning_rate: float = 5e-3
    target_entropy_scale: float = 0.5
    entropy_in_return: bool = True
    entropy_in_targets: bool = True
    normalize_entropy: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.learn_temperature or self.initial_temperature != 0.0:
            check_positive("initial_temperature", self.initial_temperature)
        for name in ("temperature_learning_rate", "target_entropy_scale"):
            check_positive(name, getattr(self, name))


@struct.dataclass
class SAPOState(FirstOrderState):
    """Everything a run is; a checkpoint holds just this."""

    log_temperature: Array
    temperature_opt: PyTree


def make_sapo(env: Env, config: SAPOConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """SAPO on an environment.

    Args:
      env, randomize: as for ``rewax.agents.actor_critic.actor_agent``.
      config: hyper-parameters.
    """
    config = SAPOConfig() if config is None else config
    return actor_agent("sapo", env, config, init=init, train_step=train_step, randomize=randomize)


def init(config: SAPOConfig, leaves: EnvLeaves, key: Key) -> SAPOState:
    """The state of a run that has not begun."""
    networks = make_actor_critic(leaves.first(), config)
    base = start_actor_critic(networks, leaves, key)
    log_temperature = jnp.log(jnp.full((), config.initial_temperature))
    temperature_opt = networks.optimizer(config.temperature_learning_rate).init(log_temperature)
    return SAPOState(**fields(base), log_temperature=log_temperature, temperature_opt=temperature_opt)


def train_step(config: SAPOConfig, state: SAPOState) -> tuple[SAPOState, Metrics]:
    """One iteration: actor, temperature, critics."""
    networks = make_actor_critic(state.environments.env.first(), config)
    key, rollout_key = jax.random.split(state.key)

    def loss(
        actor_params: PyTree, common: SAPOState, env: AutoReset, env_state: State, key: Key
    ) -> tuple[Array, Stretch]:
        return actor_loss(networks, common, actor_params, env, env_state, key)

    actor, data, actor_metrics = actor_update(networks, state, loss, rollout_key)

    entropy = data.transitions.extras["entropy"]
    mean_entropy = jnp.mean(entropy, where=data.transitions.valid)
    temperature = {"log_temperature": state.log_temperature, "temperature_opt": state.temperature_opt}
    if config.learn_temperature:
        temperature = update_temperature(
            **temperature,
            entropy=mean_entropy,
            target=target_entropy(networks),
            optimizer=networks.optimizer(config.temperature_learning_rate),
        )

    reward = data.transitions.reward
    if config.entropy_in_targets:
        reward = reward + bonus(networks, temperature["log_temperature"], entropy)
    critics, critic_metrics = critic_update(networks, state, data, reward)

    new = advanced(config, state, data.state, data.transitions, key=key, **actor, **temperature, **critics)
    own = {"entropy": mean_entropy, "temperature": jnp.exp(new.log_temperature)}
    episodes = episode_metrics(state.environments, data.transitions)
    return new, {**episodes, **own, **actor_metrics, **critic_metrics}


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

    end, transitions = rollout(env, env_state, policy, key, **config.rollout_options)
    reward = transitions.reward
    if config.entropy_in_return:
        reward = reward + bonus(networks, state.log_temperature, transitions.extras["entropy"])
    return stretch_loss(networks, state, end, transitions, reward)


def target_entropy(networks: ActorCritic) -> float:
    """What the temperature steers to: minus half the number of action components in the paper."""
    return -networks.config.target_entropy_scale * networks.action_size


def bonus(networks: ActorCritic, log_temperature: Array, entropy: Array) -> Array:
    """What the entropy of each step is worth. Gradient: exact."""
    if networks.config.normalize_entropy:
        entropy = normalized_entropy(entropy, target_entropy(networks))
    return jnp.exp(log_temperature) * entropy
