"""SAPO, soft analytic policy optimization: maximum-entropy first-order reinforcement learning.

One iteration: every environment acts for a short horizon. The soft return of that segment plus the soft value at its
end is differentiated through the simulation with respect to the actor's parameters. Then temperature and critics are
updated.

Source: Xing, Luk and Oh 2025, "Stabilizing Reinforcement Learning in Differentiable Multiphysics Simulation"
(ICLR 2025), with these corrections of its code:

- Targets always bootstrap with V(s_{t+1}).
- A reset cuts the gradient of its own environment only.
- The gradient norm is clipped over all parameters of an optimizer.
- Environments with a non-finite gradient are left out of the mean and counted.
- A step that failed numerically is masked. Theirs has reward 0.

On tasks without point clouds their networks have no encoder, as here with ``vector_features`` 0, which the presets of
``paper`` have. Those of ``small`` begin with a layer of 64 features, which all value heads share.
"""

import dataclasses
import functools
from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp

from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import FirstOrderConfig
from rewax.agents.first_order import Rollout, actor_update, critic_update, rollout_loss, start_actor_critic
from rewax.agents.legal import POSITIVE, Positive
from rewax.agents.normalization import RunningStatistics
from rewax.agents.rollout import Policy, rollout
from rewax.agents.temperature import SoftState, normalized_entropy, start_temperature, update_temperature
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.memory import remembered
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, Observation, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class SAPOConfig(FirstOrderConfig):
    """Hyper-parameters beyond those of ``FirstOrderConfig``; the defaults are the paper's for the deformable tasks.

    Attributes:
      initial_temperature: initial temperature alpha; constant if ``learn_temperature`` is False.
      learn_temperature: adapt alpha such that the entropy reaches its target.
      temperature_learning_rate: constant learning rate of the logarithm of the temperature. Its optimizer has the
        weight decay of the others.
      target_entropy_scale: the target entropy is minus this times the number of action components.
      entropy_in_return, entropy_in_targets: add the entropy bonus to the actor's return, to the critics' targets.
      entropy_in_loss: if the return has no bonus, subtract its undiscounted mean over the rollout from the actor's
        loss, as in the paper's code.
      normalize_entropy: scale the bonus to 0 at the target entropy and 1 at minus the target; else it is the entropy.
    """

    initial_temperature: float = 1.0
    learn_temperature: bool = True
    temperature_learning_rate: Positive = 5e-3
    target_entropy_scale: Positive = 0.5
    entropy_in_return: bool = True
    entropy_in_targets: bool = True
    entropy_in_loss: bool = True
    normalize_entropy: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.learn_temperature or self.initial_temperature != 0.0:
            POSITIVE.check("initial_temperature", self.initial_temperature)


Networks: TypeAlias = ActorCritic[SAPOConfig]
S = TypeVar("S", bound=SoftState)


def make_sapo(env: Env, config: SAPOConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """SAPO on an environment; arguments as for ``rewax.agents.actor_critic.actor_agent``."""
    config = SAPOConfig.given(config)
    return actor_agent("sapo", env, config, init=init, train_step=train_step, randomize=randomize)


def init(config: SAPOConfig, leaves: EnvLeaves, key: Key) -> SoftState:
    """The first state of a run."""
    networks = make_actor_critic(leaves.first(), config)
    log_alpha, opt = start_temperature(networks, config.initial_temperature, config.temperature_learning_rate)
    return start_actor_critic(SoftState, networks, leaves, key, log_temperature=log_alpha, temperature_opt=opt)


def train_step(config: SAPOConfig, state: S) -> tuple[S, Metrics]:
    """One iteration: actor, temperature, critics."""
    networks = make_actor_critic(state.environments.env.first(), config)
    key, rollout_key = jax.random.split(state.key)
    loss = functools.partial(actor_loss, networks=networks)

    state, actor_metrics, rollouts = actor_update(networks, state, loss, rollout_key, max_norm=config.max_env_grad_norm)
    state, metrics = after_actor(networks, state, rollouts, key)
    return state, {**metrics, **actor_metrics}


def after_actor(networks: Networks, state: S, rollouts: Rollout, key: Key) -> tuple[S, Metrics]:
    """The rest of an iteration after the actor's update: temperature, critics, environments.

    Args:
      networks, state: actor and critics, and the run with the updated actor.
      rollouts: rollouts with ``entropy`` in ``aux``, leading axis of environments.
      key: key of the next iteration.
    """
    config = networks.config
    entropy = rollouts.transitions.aux["entropy"]
    mean_entropy = jnp.mean(entropy, where=rollouts.transitions.valid)
    own = {"entropy": mean_entropy, "temperature": jnp.exp(state.log_temperature)}
    if config.learn_temperature:
        rate, target = config.temperature_learning_rate, target_entropy(networks)
        state, temperature = update_temperature(networks, state, mean_entropy, target=target, learning_rate=rate)
        own |= temperature

    reward = rollouts.transitions.reward
    if config.entropy_in_targets:
        reward = reward + bonus(networks, state.log_temperature, entropy)
    state, critic_metrics = critic_update(networks, state, rollouts, reward)

    state, episode_metrics = state.after(config, rollouts.end, rollouts.transitions, key)
    return state, {**episode_metrics, **own, **critic_metrics}


def actor_loss(
    actor_params: PyTree, common: SoftState, env: AutoReset, env_state: State, key: Key, *, networks: Networks
) -> tuple[Array, Rollout]:
    """Minus the soft return per step of one environment's rollout. Gradient: through the simulation.

    Source: Xing, Luk and Oh 2025, section on SAPO: SHAC's loss with r + alpha H in place of r.
    """
    config, policy = networks.config, soft_policy(networks, actor_params, common.environments.statistics)
    end, transitions = rollout(env, env_state, policy, key, horizon=config.horizon, **config.gradient_flow)
    soft = bonus(networks, common.log_temperature, transitions.aux["entropy"])
    if config.entropy_in_return:
        return rollout_loss(networks, common, end, transitions, transitions.reward + soft)
    loss, rollouts = rollout_loss(networks, common, end, transitions, transitions.reward)
    if config.entropy_in_loss:
        loss = loss - jnp.sum(soft, where=transitions.valid) / jnp.sum(transitions.active)
    return loss, rollouts


def soft_policy(networks: Networks, actor_params: PyTree, statistics: RunningStatistics) -> Policy:
    """A policy that samples an action and, in aux, an estimate of the entropy from a second sample."""

    def policy(obs: Observation, key: Key) -> tuple[Array, dict[str, Array]]:
        distribution, memory = networks.decide(actor_params, networks.normalize(statistics, obs))
        action_key, entropy_key = jax.random.split(key)
        _, log_prob = distribution.sample_and_log_prob(entropy_key)  # an independent sample
        return remembered(distribution.sample(action_key), memory), {"entropy": -log_prob}

    return policy


def target_entropy(networks: Networks) -> float:
    """Target entropy: minus ``target_entropy_scale`` (1/2 in the paper) times the number of action components."""
    return -networks.config.target_entropy_scale * networks.action_size


def bonus(networks: Networks, log_temperature: Array, entropy: Array) -> Array:
    """alpha times the (normalised) entropy of each step. Gradient: exact."""
    if networks.config.normalize_entropy:
        entropy = normalized_entropy(entropy, target_entropy(networks))
    return jnp.exp(log_temperature) * entropy
