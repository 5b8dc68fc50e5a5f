"""SAC, soft actor-critic: off-policy maximum-entropy reinforcement learning; no gradient of the simulation is used.

Source: Haarnoja et al. 2018, "Soft Actor-Critic Algorithms and Applications"; settings as in Xing, Luk and Oh 2025.
Different from theirs: actor and critics have an encoder each, the next observation of a time limit is the episode's
last, and failed steps are masked.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax

from rewax import struct
from rewax.agents import replay as replays
from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import ActorCriticConfig, check_count, check_positive, check_share
from rewax.agents.episodes import episode_metrics
from rewax.agents.gradients import finite_or_zero
from rewax.agents.optimizers import apply
from rewax.agents.replay import Replay, Sample, Step
from rewax.agents.rollout import rollout
from rewax.agents.run_state import PolicyState, advanced, fields, first_observation, run_keys, start_policy
from rewax.agents.temperature import update_temperature
from rewax.envs.base import Env
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.types import Array, Key, Observation, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class SACConfig(ActorCriticConfig):
    """Hyper-parameters beyond those of ``ActorCriticConfig``; learning rates are constant.

    A checkpoint holds the replay buffer: with large observations take a smaller one, or checkpoints less often.

    Attributes:
      replay_size: steps of all environments together that are kept; rounded down to whole iterations.
      batch_size: samples of one update.
      updates: per iteration.
      warmup_steps: control steps of each environment with uniformly random actions before the first update.
      num_steps: n of the n-step returns.
      target_rate: share of the new parameters that the target network takes at each update.
      initial_temperature, temperature_learning_rate, target_entropy_scale: as for SAPO.
    """

    actor_learning_rate: float = 5e-4
    final_learning_rate: float = 5e-4
    adam_b1: float = 0.9
    adam_b2: float = 0.999
    initial_gain: float = 2.0**0.5
    observation_clip: float | None = 5.0
    replay_size: int = 1_000_000
    batch_size: int = 1024
    updates: int = 8
    warmup_steps: int = 32
    num_steps: int = 3
    target_rate: float = 0.005
    initial_temperature: float = 1.0
    temperature_learning_rate: float = 5e-3
    target_entropy_scale: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("batch_size", "updates", "num_steps", "replay_size"):
            check_count(name, getattr(self, name))
        for name in ("initial_temperature", "temperature_learning_rate", "target_entropy_scale"):
            check_positive(name, getattr(self, name))
        check_share("target_rate", self.target_rate)
        if self.replay_size < self.samples:
            raise ValueError(
                f"replay_size is {self.replay_size}, less than the {self.samples} steps of one iteration "
                "(num_envs * horizon): make it larger"
            )

    @property
    def capacity(self) -> int:
        """Steps of each environment that are kept."""
        return self.replay_size // self.samples * self.horizon


@struct.dataclass
class SACState(PolicyState):
    """Everything a run is; a checkpoint holds just this.

    Attributes:
      critic_params, critic_opt, target_params: of the action values and of their slow copy.
      log_temperature, temperature_opt: of the price of entropy.
      replay: what was seen.
    """

    critic_params: PyTree
    critic_opt: PyTree
    target_params: PyTree
    log_temperature: Array
    temperature_opt: PyTree
    replay: Replay


def make_sac(env: Env, config: SACConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """SAC on an environment. ``train_step`` consumes its input: the replay buffer is changed in place.

    Args:
      env, randomize: as for ``rewax.agents.actor_critic.actor_agent``.
      config: hyper-parameters.
    """
    config = SACConfig() if config is None else config
    return actor_agent("sac", env, config, init=init, train_step=train_step, randomize=randomize, donate=True)


def init(config: SACConfig, leaves: EnvLeaves, key: Key) -> SACState:
    """The state of a run that has not begun."""
    env = leaves.first()
    networks, keys = make_actor_critic(env, config), run_keys(key)
    base = start_policy(networks, leaves, keys)
    base = base.replace(actor_opt=networks.optimizer(config.actor_learning_rate).init(base.actor_params))
    obs, action = first_observation(base), jnp.zeros(env.action_spec.shape)
    critic_params = networks.critics.init(keys.critics, obs, action)
    log_temperature = jnp.log(jnp.full((), config.initial_temperature))
    all_obs, flag = base.environments.state.obs, jnp.zeros(config.num_envs, bool)
    step = Step(
        obs=all_obs,
        action=jnp.zeros((config.num_envs, *env.action_spec.shape)),
        reward=jnp.zeros(config.num_envs),
        next_obs=all_obs,
        terminated=flag,
        done=flag,
        valid=flag,
    )
    return SACState(
        **fields(base),
        critic_params=critic_params,
        critic_opt=networks.optimizer(config.critic_learning_rate).init(critic_params),
        target_params=critic_params,
        log_temperature=log_temperature,
        temperature_opt=networks.optimizer(config.temperature_learning_rate).init(log_temperature),
        replay=replays.make_replay(step, config.capacity),
    )


def train_step(config: SACConfig, state: SACState) -> tuple[SACState, Metrics]:
    """One iteration: act, remember, update."""
    networks = make_actor_critic(state.environments.env.first(), config)
    key, rollout_key, update_key = jax.random.split(state.key, 3)
    warming_up = state.iteration * config.horizon < config.warmup_steps

    def act(common: tuple[PyTree, Any, Array], env: Any, env_state: Any, key: Key):
        actor_params, statistics, warming_up = common

        def policy(obs: Observation, key: Key) -> tuple[Array, dict[str, Array]]:
            distribution = networks.action_distribution(actor_params, statistics, obs)
            chosen = distribution.sample(key)
            random = jax.random.uniform(key, chosen.shape, chosen.dtype, -1.0, 1.0)
            return jnp.where(warming_up, random, chosen), {}

        return rollout(env, env_state, policy, key, horizon=config.horizon, differentiate="none")

    common = (state.actor_params, state.environments.statistics, warming_up)
    end, t = state.environments.map(act, common, state.environments.split(rollout_key))
    seen = Step(t.obs, t.action, t.reward, t.next_obs, t.terminated, t.done, t.valid)
    replay = replays.add(state.replay, jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), seen))
    new = advanced(config, state, end, t, key=key, replay=replay)

    def one_update(learnt: dict[str, Any], key: Key) -> tuple[dict[str, Any], Metrics]:
        return update(networks, new.replace(**learnt), key)

    learnt = {name: getattr(new, name) for name in _LEARNT}
    after, said = jax.lax.scan(one_update, learnt, jax.random.split(update_key, config.updates))
    learnt = jax.tree.map(lambda a, b: jnp.where(warming_up, a, b), learnt, after)
    metrics = {**jax.tree.map(jnp.mean, said), "temperature": jnp.exp(learnt["log_temperature"])}
    return new.replace(**learnt), {**episode_metrics(state.environments, t), **metrics}


_LEARNT = (
    "actor_params",
    "actor_opt",
    "critic_params",
    "critic_opt",
    "target_params",
    "log_temperature",
    "temperature_opt",
)


def update(networks: ActorCritic, state: SACState, key: Key) -> tuple[dict[str, Any], Metrics]:
    """One update of critics, actor, temperature and target network on a batch from the replay buffer.

    Returns:
      The fields of the state that change, and metrics.
    """
    config, statistics = networks.config, state.environments.statistics
    batch_key, next_key, actor_key = jax.random.split(key, 3)
    batch = replays.sample(
        state.replay, batch_key, config.batch_size, num_steps=config.num_steps, discount=config.discount
    )
    batch = batch._replace(obs=networks.seen(statistics, batch.obs), next_obs=networks.seen(statistics, batch.next_obs))

    critic_grad, critic_metrics = jax.grad(lambda p: critic_loss(networks, state, p, batch, next_key), has_aux=True)(
        state.critic_params
    )
    optimizer = networks.optimizer(config.critic_learning_rate)
    critic_params, critic_opt = apply(optimizer, finite_or_zero(critic_grad), state.critic_opt, state.critic_params)

    actor_grad, (entropy, actor_metrics) = jax.grad(
        lambda p: actor_loss(networks, state, p, critic_params, batch, actor_key), has_aux=True
    )(state.actor_params)
    optimizer = networks.optimizer(config.actor_learning_rate)
    actor_params, actor_opt = apply(optimizer, finite_or_zero(actor_grad), state.actor_opt, state.actor_params)
    temperature = update_temperature(
        state.log_temperature,
        state.temperature_opt,
        entropy=entropy,
        target=-config.target_entropy_scale * networks.action_size,
        optimizer=networks.optimizer(config.temperature_learning_rate),
    )
    changes = {
        "actor_params": actor_params,
        "actor_opt": actor_opt,
        "critic_params": critic_params,
        "critic_opt": critic_opt,
        "target_params": optax.incremental_update(critic_params, state.target_params, config.target_rate),
        **temperature,
    }
    return changes, {**critic_metrics, **actor_metrics, "actor_grad_norm": optax.tree.norm(actor_grad)}


def critic_loss(
    networks: ActorCritic, state: SACState, params: PyTree, batch: Sample, key: Key
) -> tuple[Array, Metrics]:
    """Mean square error of all action values against the soft n-step target of the smaller one."""
    action, log_prob = _sampled(networks, state.actor_params, batch.next_obs, key)
    next_value = action_values(networks, state.target_params, batch.next_obs, action).min(axis=-1)
    soft = next_value - jnp.exp(state.log_temperature) * log_prob
    target = jax.lax.stop_gradient(batch.reward + batch.discount * soft)
    error = action_values(networks, params, batch.obs, batch.action) - target[:, None]
    loss = _mean(jnp.mean(error**2, axis=-1), batch.valid)
    return loss, {"critic_loss": loss, "value": _mean(target, batch.valid)}


def actor_loss(
    networks: ActorCritic, state: SACState, params: PyTree, critic_params: PyTree, batch: Sample, key: Key
) -> tuple[Array, tuple[Array, Metrics]]:
    """Minus the soft value of the policy's own actions; and its entropy."""
    action, log_prob = _sampled(networks, params, batch.obs, key)
    value = action_values(networks, critic_params, batch.obs, action).min(axis=-1)
    loss = _mean(jnp.exp(state.log_temperature) * log_prob - value, batch.valid)
    entropy = -_mean(log_prob, batch.valid)
    return loss, (entropy, {"actor_loss": loss, "entropy": entropy})


def action_values(networks: ActorCritic, params: PyTree, seen: Observation, action: Array) -> Array:
    """By all critics, shape (n, num_critics). Gradient: exact."""
    out: Any = jax.vmap(lambda obs, action: networks.critics.apply(params, obs, action))(seen, action)
    return out


def _sampled(networks: ActorCritic, params: PyTree, seen: Observation, key: Key) -> tuple[Array, Array]:
    """Actions and their log probabilities, one of each for every observation."""
    keys = jax.random.split(key, len(jax.tree.leaves(seen)[0]))
    return jax.vmap(lambda obs, key: networks.distribution(params, obs).sample_and_log_prob(key))(seen, keys)


def _mean(values: Array, valid: Array) -> Array:
    return jnp.sum(jnp.where(valid, values, 0.0)) / jnp.maximum(valid.sum(), 1)
