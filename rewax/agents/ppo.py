"""PPO, proximal policy optimisation: the zeroth-order baseline, which uses no gradient of the simulation.

One iteration: every environment acts for ``horizon`` steps, then several epochs maximise the clipped surrogate
objective on these samples. A train step uses ``actor_critic`` (networks and their optimizer), ``run_state``
(environments and counters), ``rollout`` and ``returns``.

Source: Schulman et al. 2017, "Proximal Policy Optimization Algorithms"; generalised advantage estimation (GAE) from
Schulman et al. 2016; settings as in Xing, Luk and Oh 2025. Differences from their code:

- Actor and critic have separate encoders.
- Actions come from a normal distribution squashed by tanh. Theirs come from a normal distribution with a squashed mean,
  and are clipped.
- The standard deviation is exp(s), for an output s clamped to [-5, 2], and begins at 1. Theirs is
  0.9 sigmoid(s + 2) + 0.1, and begins at 0.89.
- Adam's epsilon is 1e-8. Theirs is 1e-5.
- At a time limit, the value is that of the last observation of the episode.
- Failed steps are masked.
- A probability ratio above e^20 counts as e^20.
- A policy with memory is recomputed through time: minibatches are whole environments, and the memory begins as it was
  at the first step of the rollout.
"""

import dataclasses
import functools
from typing import Annotated, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax

from rewax import struct
from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import ActorCriticConfig
from rewax.agents.distributions import TanhNormal
from rewax.agents.legal import INTERVAL, POSITIVE, Count, Legal, NonNegative, Positive, Share
from rewax.agents.normalization import RunningStatistics, init_statistics, update_statistics
from rewax.agents.returns import td_lambda
from rewax.agents.rollout import Transition, masked, rollout
from rewax.agents.run_state import PolicyState, run_keys, start_environments
from rewax.envs.base import ArraySpec, Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.memory import remembered
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, Observation, PyTree

_LARGEST_LOG_RATIO = 20.0
"""Limit of the logarithm of the probability ratio, far outside of the clip range. Beyond 88 the ratio overflows in
float32, and one such sample would make the gradient of its minibatch NaN."""
_RATES = Legal("give two positive numbers in ascending order", lambda v: INTERVAL.holds(v) and v[0] > 0.0)
_FIXED_RATE = "give a positive number, or None for a fixed learning rate"


@dataclasses.dataclass(frozen=True, kw_only=True)
class PPOConfig(ActorCriticConfig):
    """Hyper-parameters beyond those of ``ActorCriticConfig``.

    Attributes:
      actor_learning_rate: initial learning rate of actor and critic; ``target_kl`` adapts it. ``critic_learning_rate``
        and ``final_learning_rate`` are not used.
      num_critics: must be 1.
      gae_lambda: lambda of the advantages, GAE(lambda) [-].
      clip_range: clip range of the probability ratio.
      epochs, minibatches: passes over each iteration's data, and minibatches per pass; shuffled in each pass.
      value_coefficient: weight of half the squared error of the values.
      entropy_coefficient: weight of the entropy of the normal distribution before its tanh.
      target_kl: KL divergence towards which the learning rate is adapted; None: a fixed learning rate. Each pass over
        the data takes the mean over its minibatches, before their updates. So the first minibatch of an iteration adds
        0, and with one minibatch the rate rises after the first pass of every iteration.
      learning_rate_range: limits of the learning rate.
      normalize_values: the critic predicts returns minus their running mean, in units of their running deviation.
    """

    actor_learning_rate: float = 5e-4
    adam_b1: float = 0.9
    adam_b2: float = 0.999
    initial_gain: float = 2.0**0.5
    action_gain: float | None = 0.01
    value_gain: float | None = 1.0
    num_critics: int = 1
    observation_clip: float | None = 5.0
    gae_lambda: Share = 0.95
    clip_range: Positive = 0.2
    epochs: Count = 5
    minibatches: Count = 1
    value_coefficient: Positive = 4.0
    entropy_coefficient: NonNegative = 0.0
    target_kl: Annotated[float | None, POSITIVE.or_none(_FIXED_RATE)] = 0.008
    learning_rate_range: Annotated[tuple[float, float], _RATES] = (1e-6, 1e-2)
    normalize_values: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.learning_rate_range
        if self.target_kl is not None and not low <= self.actor_learning_rate <= high:
            raise ValueError(
                f"actor_learning_rate is {self.actor_learning_rate}, but learning_rate_range is "
                f"{self.learning_rate_range}: give a rate between its ends, or target_kl None for a fixed rate"
            )
        if self.samples < 2:
            raise ValueError(
                "num_envs * horizon is 1: give at least 2, because the advantage of a single sample is normalised to 0"
            )
        if self.num_critics != 1:
            raise ValueError(f"num_critics is {self.num_critics}: PPO has one critic, give 1")
        if self.samples % self.minibatches:
            raise ValueError(
                f"minibatches is {self.minibatches}, which does not divide num_envs * horizon = {self.samples}: "
                "choose a divisor"
            )
        if self.memory and self.num_envs % self.minibatches:
            raise ValueError(
                f"minibatches is {self.minibatches}, which does not divide num_envs = {self.num_envs}: choose a "
                "divisor, because a minibatch of a policy with memory is the sequences of whole environments"
            )

    @property
    def start_only(self) -> frozenset[str]:
        """With ``target_kl`` the learning rate, too, is that of the run."""
        return super().start_only | ({"actor_learning_rate"} if self.target_kl is not None else set())


Networks: TypeAlias = ActorCritic[PPOConfig]


@struct.dataclass
class PPOState(PolicyState):
    """The complete state of a run, as stored in a checkpoint.

    Attributes:
      actor_params: parameters of the policy network.
      actor_opt: state of the optimizer, which updates actor and critic together.
      critic_params: parameters of the value network.
      value_statistics: mean and variance of the returns that the critic predicts.
      learning_rate: learning rate of the next epoch, shape ().
    """

    critic_params: PyTree
    value_statistics: RunningStatistics
    learning_rate: Array


def make_ppo(env: Env, config: PPOConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """PPO on an environment; arguments as for ``rewax.agents.actor_critic.actor_agent``."""
    config = PPOConfig.given(config)
    return actor_agent("ppo", env, config, init=init, train_step=train_step, randomize=randomize)


class Batch(NamedTuple):
    """Samples of a rollout, leading axes (num_envs, T), or (n,) in a minibatch; with memory, (n, T).

    Attributes:
      obs: normalised observations.
      raw, log_prob: the action before its tanh, and the log probability of the action.
      mean, log_std: parameters of the normal distribution that the action was sampled from.
      target: target of the critic.
      advantage: normalised advantage.
      weight: 0 for masked samples, else 1.
      begins: with memory, whether the memory of the observation counts, see ``Actor.distributions``; else None.
    """

    obs: Observation
    raw: Array
    log_prob: Array
    mean: Array
    log_std: Array
    target: Array
    advantage: Array
    weight: Array
    begins: Array | None = None


def init(config: PPOConfig, leaves: EnvLeaves, key: Key) -> PPOState:
    """The first state of a run."""
    networks, keys = make_actor_critic(leaves.first(), config), run_keys(key)
    environments = start_environments(config, leaves, keys)
    actor_params = networks.network.init(keys.actor, environments.first_observation())
    critic_params = networks.critics.init(keys.critics, environments.first_observation())
    return PPOState(
        environments=environments,
        key=keys.run,
        actor_params=actor_params,
        actor_opt=networks.optimizer(1.0).init((actor_params, critic_params)),
        critic_params=critic_params,
        value_statistics=init_statistics({"value": ArraySpec(())}),
        learning_rate=jnp.full((), float(config.actor_learning_rate)),
    )


def train_step(config: PPOConfig, state: PPOState) -> tuple[PPOState, Metrics]:
    """One iteration: rollouts, then several epochs on them."""
    networks = make_actor_critic(state.environments.env.first(), config)
    key, rollout_key, epoch_key = jax.random.split(state.key, 3)
    if config.target_kl is None:  # a run may be resumed with another rate
        state = state.replace(learning_rate=jnp.full((), float(config.actor_learning_rate)))

    rollout_of_one = functools.partial(act, networks=networks)
    end, t = state.environments.map(rollout_of_one, state.common(), state.environments.split(rollout_key))
    batch, value_statistics = make_batch(networks, state, t)
    state, metrics = epochs(networks, state, batch, epoch_key)
    state = state.replace(value_statistics=value_statistics)
    state, episode_metrics = state.after(config, end, t, key)
    return state, {**episode_metrics, **metrics}


def act(
    common: PPOState, env: AutoReset, env_state: State, key: Key, *, networks: Networks
) -> tuple[State, Transition]:
    """Rollout of one environment."""

    def policy(obs: Observation, key: Key) -> tuple[Array, dict[str, Array]]:
        normalized = networks.normalize(common.environments.statistics, obs)
        distribution, memory = networks.decide(common.actor_params, normalized)
        raw = distribution.sample_raw(key)
        aux = {"raw": raw, "mean": distribution.mean, "log_std": distribution.log_std}
        return remembered(jnp.tanh(raw), memory), {**aux, "log_prob": distribution.log_prob_raw(raw)}

    return rollout(env, env_state, policy, key, horizon=networks.config.horizon, differentiate="none")


def make_batch(networks: Networks, state: PPOState, t: Transition) -> tuple[Batch, RunningStatistics]:
    """Samples with normalised targets and advantages, and the updated statistics of the targets.

    Source: advantages, Schulman et al. 2016, eq. 16 (GAE).
    """
    config, statistics = networks.config, state.value_statistics

    def values(obs: Observation) -> Array:
        normalized = networks.normalize(state.environments.statistics, obs)
        value = jax.vmap(lambda one: networks.values(state.critic_params, one))(normalized)[..., 0]
        return value * _scale(statistics) + statistics.mean["value"]

    value, next_value = values(t.obs), jnp.where(t.terminated, 0.0, values(t.next_obs))
    returns = jax.vmap(functools.partial(td_lambda, discount=config.discount, lambda_=config.gae_lambda))(
        t.reward, next_value, t.done, t.valid
    )
    advantage = jnp.where(t.valid, returns - value, 0.0)
    mean = jnp.mean(advantage, where=t.valid)
    deviation = jnp.std(advantage, where=t.valid)
    if config.normalize_values:
        statistics = update_statistics(statistics, {"value": returns}, t.valid)
    obs = networks.normalize(state.environments.statistics, t.obs)
    batch = Batch(
        obs=masked(obs, t.valid),
        **masked(t.aux, t.valid),
        target=jnp.where(t.valid, (returns - statistics.mean["value"]) / _scale(statistics), 0.0),
        advantage=jnp.where(t.valid, (advantage - mean) / (deviation + 1e-8), 0.0),
        weight=t.valid.astype(returns.dtype),
        begins=t.begins if config.memory else None,
    )
    return batch, statistics


def _scale(statistics: RunningStatistics) -> Array:
    return jnp.sqrt(statistics.variance["value"] + 1e-5)


def epochs(networks: Networks, state: PPOState, batch: Batch, key: Key) -> tuple[PPOState, Metrics]:
    """Several passes over the data. After each, the learning rate is adapted to the KL divergence."""
    config = networks.config

    def epoch(state: PPOState, key: Key) -> tuple[PPOState, Metrics]:
        parts = shuffled(key, batch, config.minibatches, sequences=config.memory > 0)
        state, rows = jax.lax.scan(functools.partial(update, networks), state, parts)
        if config.target_kl is not None:
            kl, (low, high) = rows["kl"].mean(), config.learning_rate_range
            slower, faster = kl > 2.0 * config.target_kl, kl < 0.5 * config.target_kl
            factor = jnp.where(slower, 1.0 / 1.5, jnp.where(faster, 1.5, 1.0))
            state = state.replace(learning_rate=jnp.clip(state.learning_rate * factor, low, high))
        return state, rows

    learnt, rows = jax.lax.scan(epoch, state.common(), jax.random.split(key, config.epochs))
    metrics = {name: values.mean() for name, values in rows.items()}
    metrics |= {"kl": rows["kl"][-1].mean(), "learning_rate": learnt.learning_rate}
    return learnt.replace(environments=state.environments), metrics


def update(networks: Networks, state: PPOState, batch: Batch) -> tuple[PPOState, Metrics]:
    """One optimizer step of actor and critic on a minibatch."""
    params = (state.actor_params, state.critic_params)
    grad, metrics = jax.grad(functools.partial(ppo_loss, networks=networks, batch=batch), has_aux=True)(params)
    (actor, critic), opt = networks.update(1.0, grad, state.actor_opt, params, scale=state.learning_rate)
    state = state.replace(actor_params=actor, critic_params=critic, actor_opt=opt)
    norms = {"actor_grad_norm": optax.tree.norm(grad[0]), "critic_grad_norm": optax.tree.norm(grad[1])}
    return state, {**metrics, **norms}


def ppo_loss(params: tuple[PyTree, PyTree], *, networks: Networks, batch: Batch) -> tuple[Array, Metrics]:
    """Clipped surrogate objective, value error and entropy, as means over the unmasked samples.

    Args:
      params: parameters of actor and critic.
      networks: actor and critic.
      batch: one minibatch.

    Source: Schulman et al. 2017; equation numbers stand in the code.
    """
    config, (actor_params, critic_params) = networks.config, params

    if batch.begins is None:
        now = jax.vmap(lambda obs: networks.distribution(actor_params, obs))(batch.obs)
    else:
        through_time = functools.partial(networks.distributions, actor_params)
        now, batch = _joined((jax.vmap(through_time)(batch.obs, batch.begins), batch))
    before = TanhNormal(mean=batch.mean, log_std=batch.log_std)
    log_prob = jax.vmap(TanhNormal.log_prob_raw)(now, batch.raw)
    kl = jax.vmap(TanhNormal.kl_divergence)(before, now)
    log_ratio = log_prob - batch.log_prob
    excess = jnp.maximum(log_ratio - _LARGEST_LOG_RATIO, 0.0)
    ratio = jnp.exp(log_ratio - jax.lax.stop_gradient(excess))  # its derivative is the ratio times that of the log
    clipped = jnp.clip(ratio, 1.0 - config.clip_range, 1.0 + config.clip_range)
    gain = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)  # eq. 7
    error = 0.5 * (networks.values(critic_params, batch.obs)[:, 0] - batch.target) ** 2
    weight = batch.weight / jnp.maximum(batch.weight.sum(), 1.0)
    metrics = {
        "actor_loss": -jnp.sum(weight * gain),
        "critic_loss": jnp.sum(weight * error),
        "entropy": jnp.sum(weight * now.base.entropy().sum(axis=-1)),
        "kl": jnp.sum(weight * kl),
    }
    loss = metrics["actor_loss"] + config.value_coefficient * metrics["critic_loss"]
    return loss - config.entropy_coefficient * metrics["entropy"], metrics  # minus eq. 9


def _joined(tree: PyTree) -> PyTree:
    """The first two axes as one."""
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), tree)


def shuffled(key: Key, batch: PyTree, num_parts: int, *, sequences: bool = False) -> PyTree:
    """Samples in random order, split into equal minibatches.

    Args:
      key: draws the order.
      batch: arrays with two leading axes (num_envs, T).
      num_parts: number of minibatches, a divisor of num_envs * T.
      sequences: keep the samples of an environment together, in order; num_parts is a divisor of num_envs.

    Returns:
      Arrays with leading axes (num_parts, num_envs * T / num_parts), or (num_parts, num_envs / num_parts, T).
    """
    flat = batch if sequences else _joined(batch)
    order = jax.random.permutation(key, len(jax.tree.leaves(flat)[0]))
    return jax.tree.map(lambda a: a[order].reshape(num_parts, -1, *a.shape[1:]), flat)
