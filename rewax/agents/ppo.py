"""PPO, proximal policy optimisation: the zeroth-order baseline; no gradient of the simulation is used.

Source: Schulman et al. 2017, "Proximal Policy Optimization Algorithms"; generalised advantages from Schulman et al.
2016; settings as in Xing, Luk and Oh 2025. Different from theirs: actor and critic have an encoder each, actions are a
squashed normal's (theirs a normal's with squashed mean, clipped), the value at a time limit is that of the last
observation, and failed steps are masked.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax

from rewax import struct
from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import ActorCriticConfig, check_count, check_positive, check_share
from rewax.agents.distributions import TanhNormal
from rewax.agents.episodes import episode_metrics
from rewax.agents.gradients import finite_or_zero
from rewax.agents.minibatches import shuffled
from rewax.agents.normalization import RunningStatistics, init_statistics, update_statistics
from rewax.agents.optimizers import apply
from rewax.agents.returns import td_lambda
from rewax.agents.rollout import Transition, rollout
from rewax.agents.run_state import PolicyState, advanced, fields, first_observation, run_keys, start_policy
from rewax.envs.base import ArraySpec, Env
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.types import Array, Key, Observation, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class PPOConfig(ActorCriticConfig):
    """Hyper-parameters beyond those of ``ActorCriticConfig``.

    Attributes:
      actor_learning_rate: at the start, of actor and critic; it follows the divergence then. The critic's own and the
        final one are not used.
      num_critics: 1.
      gae_lambda: lambda of the advantages [-].
      clip_range: of the ratio of probabilities.
      epochs, minibatches: how often each iteration's data is used, in how many parts; shuffled each time.
      value_coefficient: weight of half the square error of the values.
      entropy_coefficient: weight of the entropy of the normal distribution before its tanh.
      target_kl: divergence of an epoch that the learning rate is steered to; None: a fixed learning rate.
      learning_rate_range: limits of the learning rate.
      normalize_values: the critic predicts returns in units of their running standard deviation.
    """

    actor_learning_rate: float = 5e-4
    adam_b1: float = 0.9
    adam_b2: float = 0.999
    initial_gain: float = 2.0**0.5
    num_critics: int = 1
    observation_clip: float | None = 5.0
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    epochs: int = 5
    minibatches: int = 1
    value_coefficient: float = 4.0
    entropy_coefficient: float = 0.0
    target_kl: float | None = 0.008
    learning_rate_range: tuple[float, float] = (1e-6, 1e-2)
    normalize_values: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_share("gae_lambda", self.gae_lambda)
        for name in ("epochs", "minibatches"):
            check_count(name, getattr(self, name))
        for name in ("clip_range", "value_coefficient"):
            check_positive(name, getattr(self, name))
        if self.num_critics != 1:
            raise ValueError(f"num_critics is {self.num_critics}: PPO has one critic, give 1")
        if self.target_kl is not None:
            check_positive("target_kl", self.target_kl, "a positive number, or None for a fixed learning rate")
        if self.samples % self.minibatches:
            raise ValueError(
                f"minibatches is {self.minibatches}, which does not divide num_envs * horizon = {self.samples}: "
                "choose a divisor"
            )


@struct.dataclass
class PPOState(PolicyState):
    """Everything a run is; a checkpoint holds just this.

    Attributes:
      actor_params, actor_opt: the optimizer's state is that of actor and critic together.
      critic_params: of the value network.
      value_statistics: of the returns that it predicts.
      learning_rate: of the next epoch, shape ().
    """

    critic_params: PyTree
    value_statistics: RunningStatistics
    learning_rate: Array


def make_ppo(env: Env, config: PPOConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """PPO on an environment.

    Args:
      env, randomize: as for ``rewax.agents.actor_critic.actor_agent``.
      config: hyper-parameters.
    """
    config = PPOConfig() if config is None else config
    return actor_agent("ppo", env, config, init=init, train_step=train_step, randomize=randomize)


def init(config: PPOConfig, leaves: EnvLeaves, key: Key) -> PPOState:
    """The state of a run that has not begun."""
    networks, keys = make_actor_critic(leaves.first(), config), run_keys(key)
    base = start_policy(networks, leaves, keys)
    critic_params = networks.critics.init(keys.critics, first_observation(base))
    base = base.replace(actor_opt=networks.optimizer(1.0).init((base.actor_params, critic_params)))
    return PPOState(
        **fields(base),
        critic_params=critic_params,
        value_statistics=init_statistics({"value": ArraySpec(())}),
        learning_rate=jnp.full((), config.actor_learning_rate),
    )


def train_step(config: PPOConfig, state: PPOState) -> tuple[PPOState, Metrics]:
    """One iteration: rollouts, then several epochs on them."""
    networks = make_actor_critic(state.environments.env.first(), config)
    key, rollout_key, epoch_key = jax.random.split(state.key, 3)
    statistics = state.environments.statistics

    def act(common: PPOState, env: Any, env_state: Any, key: Key):
        def policy(obs: Observation, key: Key) -> tuple[Array, dict[str, Array]]:
            distribution = networks.action_distribution(common.actor_params, common.environments.statistics, obs)
            raw = distribution.sample_raw(key)
            said = {"raw": raw, "mean": distribution.mean, "log_std": distribution.log_std}
            return jnp.tanh(raw), {**said, "log_prob": distribution.log_prob_raw(raw)}

        return rollout(env, env_state, policy, key, horizon=config.horizon, differentiate="none")

    end, t = state.environments.map(act, state.common(), state.environments.split(rollout_key))
    targets, advantages, value_statistics = _targets(networks, state, t)
    batch = {
        "obs": jax.tree.map(lambda a: _masked(a, t.valid), networks.seen(statistics, t.obs)),
        **t.extras,
        "target": targets,
        "advantage": advantages,
        "weight": t.valid.astype(targets.dtype),
    }
    changes, metrics = _epochs(networks, state, batch, epoch_key)
    new = advanced(config, state, end, t, key=key, value_statistics=value_statistics, **changes)
    return new, {**episode_metrics(state.environments, t), **metrics}


def _targets(networks: ActorCritic, state: PPOState, t: Transition) -> tuple[Array, Array, RunningStatistics]:
    """Normalised targets of the values, normalised advantages, (num_envs, T) each; statistics of the targets."""
    config, statistics = networks.config, state.value_statistics

    def values(obs: Observation) -> Array:
        seen = networks.seen(state.environments.statistics, obs)
        value = jax.vmap(lambda one: networks.values(state.critic_params, one))(seen)[..., 0]
        return value * _scale(statistics) + statistics.mean["value"]

    value, next_value = values(t.obs), jnp.where(t.terminated, 0.0, values(t.next_obs))
    returns = jax.vmap(lambda *steps: td_lambda(*steps, discount=config.discount, lambda_=config.gae_lambda))(
        t.reward, next_value, t.done, t.valid
    )
    advantage = jnp.where(t.valid, returns - value, 0.0)
    mean = jnp.mean(advantage, where=t.valid)
    deviation = jnp.std(advantage, where=t.valid)
    advantage = jnp.where(t.valid, (advantage - mean) / (deviation + 1e-8), 0.0)
    if config.normalize_values:
        statistics = update_statistics(statistics, {"value": returns}, t.valid)
    target = jnp.where(t.valid, (returns - statistics.mean["value"]) / _scale(statistics), 0.0)
    return target, advantage, statistics


def _scale(statistics: RunningStatistics) -> Array:
    return jnp.sqrt(statistics.variance["value"] + 1e-5)


def _epochs(networks: ActorCritic, state: PPOState, batch: dict[str, Any], key: Key) -> tuple[dict[str, Any], Metrics]:
    """Several passes over the data; the learning rate follows the divergence after each."""
    config = networks.config

    def update(carry: tuple[PyTree, PyTree, Array], part: dict[str, Any]):
        params, opt, learning_rate = carry
        grad, said = jax.grad(lambda p: ppo_loss(networks, p, part), has_aux=True)(params)
        updated = apply(networks.optimizer(1.0), finite_or_zero(grad), opt, params, scale=learning_rate)
        return (*updated, learning_rate), {**said, "actor_grad_norm": optax.tree.norm(grad)}

    def epoch(carry: tuple[PyTree, PyTree, Array], key: Key):
        (params, opt, learning_rate), said = jax.lax.scan(update, carry, shuffled(key, batch, config.minibatches))
        if config.target_kl is not None:
            kl, (low, high) = said["kl"].mean(), config.learning_rate_range
            slower, faster = kl > 2.0 * config.target_kl, kl < 0.5 * config.target_kl
            factor = jnp.where(slower, 1.0 / 1.5, jnp.where(faster, 1.5, 1.0))
            learning_rate = jnp.clip(learning_rate * factor, low, high)
        return (params, opt, learning_rate), said

    start = ((state.actor_params, state.critic_params), state.actor_opt, state.learning_rate)
    end: Any
    end, said = jax.lax.scan(epoch, start, jax.random.split(key, config.epochs))
    (actor_params, critic_params), opt, learning_rate = end
    learnt = {"actor_params": actor_params, "critic_params": critic_params, "actor_opt": opt}
    metrics = {name: values.mean() for name, values in said.items()}
    changes = {**learnt, "learning_rate": learning_rate}
    return changes, {**metrics, "kl": said["kl"][-1].mean(), "learning_rate": learning_rate}


def ppo_loss(networks: ActorCritic, params: Any, batch: dict[str, Any]) -> tuple[Array, Metrics]:
    """The clipped surrogate, the values' error and the entropy, means over the samples that count."""
    config, (actor_params, critic_params) = networks.config, params

    now = jax.vmap(lambda obs: networks.distribution(actor_params, obs))(batch["obs"])
    before = TanhNormal(mean=batch["mean"], log_std=batch["log_std"])
    log_prob = jax.vmap(TanhNormal.log_prob_raw)(now, batch["raw"])
    kl = jax.vmap(TanhNormal.kl_divergence)(before, now)
    ratio = jnp.exp(log_prob - batch["log_prob"])
    clipped = jnp.clip(ratio, 1.0 - config.clip_range, 1.0 + config.clip_range)
    gain = jnp.minimum(ratio * batch["advantage"], clipped * batch["advantage"])
    error = 0.5 * (networks.values(critic_params, batch["obs"])[:, 0] - batch["target"]) ** 2
    weight = batch["weight"] / jnp.maximum(batch["weight"].sum(), 1.0)
    said = {
        "actor_loss": -jnp.sum(weight * gain),
        "critic_loss": jnp.sum(weight * error),
        "entropy": jnp.sum(weight * now.base.entropy().sum(axis=-1)),
        "kl": jnp.sum(weight * kl),
    }
    loss = said["actor_loss"] + config.value_coefficient * said["critic_loss"]
    return loss - config.entropy_coefficient * said["entropy"], said


def _masked(a: Array, valid: Array) -> Array:
    return jnp.where(valid.reshape(*valid.shape, *[1] * (a.ndim - 2)), a, 0.0)
