"""SAC, soft actor-critic: off-policy maximum-entropy reinforcement learning; no gradient of the simulation is used.

Source: Haarnoja et al. 2018, "Soft Actor-Critic Algorithms and Applications"; settings as in Xing, Luk and Oh 2025.
Differences from their code:

- Actor and critics have separate encoders.
- At a time limit, the next observation is the last of the episode.
- Failed steps are masked.
- The temperature, too, has AdamW's weight decay.
- The critics' loss is the mean over critics. Theirs is the sum, so our gradient is half as large before it is clipped.
"""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Hashable
from typing import Annotated, Self, TypeAlias, cast

import jax
import jax.numpy as jnp
import optax

from rewax import struct
from rewax.agents import replay as replays
from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import ReplayConfig, no_memory
from rewax.agents.normalization import RunningStatistics
from rewax.agents.replay import Replay, Sample, Step
from rewax.agents.rollout import Transition, masked, rollout
from rewax.agents.run_state import Environments, run_keys, start_environments
from rewax.agents.temperature import SoftState, start_temperature, update_temperature
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset, select
from rewax.types import Array, Key, Observation, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class SACConfig(ReplayConfig):
    """Hyper-parameters: those of ``ReplayConfig``. Learning rates are constant: ``final_learning_rate`` and
    ``num_iterations`` have no effect on them.
    """

    actor_learning_rate: float = 5e-4
    final_learning_rate: float = 5e-4
    adam_b1: float = 0.9
    adam_b2: float = 0.999
    initial_gain: float = 2.0**0.5
    observation_clip: float | None = 5.0
    memory: Annotated[int, no_memory("SAC learns from single transitions")] = 0


Networks: TypeAlias = ActorCritic[ReplayConfig]

Update: TypeAlias = Callable[["SACState", Key], tuple["SACState", Metrics]]
Loss: TypeAlias = Callable[..., tuple[Array, Metrics]]
Bound: TypeAlias = Callable[[PyTree], PyTree]

LARGE_REPLAY = 8e9
"""Size of a replay buffer above which a warning says it [bytes]: pictures at the default capacity have it."""


@struct.dataclass
class SACState(SoftState):
    """The complete state of a run; this is what a checkpoint stores.

    Attributes:
      critic_params, critic_opt: parameters of the action-value networks, and the state of their optimizer.
      target_params: parameters of the target network.
      replay: the replay buffer.
    """

    replay: Replay

    def restarted(self, config: Hashable) -> Self:
        """See ``RunState.restarted``. Stored steps are not continued by those of the new episodes."""
        state = cast(Self, SoftState.restarted(self, config))
        return state.replace(replay=replays.ended(self.replay))


def make_sac(env: Env, config: SACConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """SAC on an environment; arguments as for ``rewax.agents.actor_critic.actor_agent``.

    ``train_step`` consumes its input, because it changes the replay buffer in place.
    """
    config = SACConfig.given(config)
    return actor_agent("sac", env, config, init=init, train_step=train_step, randomize=randomize, donate=True)


def init(config: SACConfig, leaves: EnvLeaves, key: Key) -> SACState:
    """The first state of a run."""
    return start(make_actor_critic(leaves.first(), config), leaves, key)


def start(networks: Networks, leaves: EnvLeaves, key: Key) -> SACState:
    """The first state of a run with given networks."""
    config, keys = networks.config, run_keys(key)
    environments = start_environments(config, leaves, keys)
    obs, action = environments.first_observation(), jnp.zeros(networks.action_size)
    actor_params = networks.network.init(keys.actor, obs)
    critic_params = networks.critics.init(keys.critics, obs, action)
    log_alpha, alpha_opt = start_temperature(networks, config.initial_temperature, config.temperature_learning_rate)
    return SACState(
        environments=environments,
        key=keys.run,
        actor_params=actor_params,
        actor_opt=networks.optimizer(config.actor_learning_rate).init(actor_params),
        critic_params=critic_params,
        critic_opt=networks.optimizer(config.critic_learning_rate).init(critic_params),
        target_params=critic_params,
        log_temperature=log_alpha,
        temperature_opt=alpha_opt,
        replay=_empty_replay(environments, action, config.capacity),
    )


def _empty_replay(environments: Environments, action: Array, capacity: int) -> Replay:
    num_envs, obs = environments.num_envs, environments.state.obs
    flag = jnp.zeros(num_envs, bool)
    actions = jnp.zeros((num_envs, *action.shape))
    step = Step(obs, actions, jnp.zeros(num_envs), obs, flag, flag, flag)
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(step))
    if capacity * size > LARGE_REPLAY:
        warnings.warn(
            f"the replay buffer takes {capacity * size / 1e9:.0f} GB: a replay_size of "
            f"{int(LARGE_REPLAY / size * num_envs)} takes {LARGE_REPLAY / 1e9:.0f} GB",
            stacklevel=2,
        )
    return replays.make_replay(step, capacity)


def train_step(config: SACConfig, state: SACState) -> tuple[SACState, Metrics]:
    """One iteration: act, add to the replay buffer, update."""
    networks = make_actor_critic(state.environments.env.first(), config)

    def updates(replay: Replay) -> Update:
        scale = replays.return_scale(replay, config.discount) if config.normalize_rewards else None
        return functools.partial(update, networks, replay, scale)

    return iterate(networks, state, act, updates, config.updates)


def iterate(
    networks: Networks,
    state: SACState,
    act: Callable[..., tuple[State, Transition]],
    updates: Callable[[Replay], Update],
    num_updates: int,
) -> tuple[SACState, Metrics]:
    """One iteration of an algorithm with a replay buffer.

    Args:
      networks, state: the run.
      act: rollout of one environment, as ``act`` of this module.
      updates: from the buffer, the update ``(state, key) -> (state, metrics)``.
      num_updates: number of updates.
    """
    config = networks.config
    key, rollout_key, update_key = jax.random.split(state.key, 3)
    warming_up = state.iteration * config.horizon < config.warmup_steps

    rollout_of_one = functools.partial(act, networks=networks)
    shared = (state.actor_params, state.environments.statistics, warming_up)
    end, t = state.environments.map(rollout_of_one, shared, state.environments.split(rollout_key))
    obs, action, reward, next_obs = masked((t.obs, t.action, t.reward, t.next_obs), t.valid)
    steps = Step(obs, action, reward, next_obs, t.terminated, t.done, t.valid)
    replay = replays.add(state.replay, jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), steps))
    state, episode_metrics = state.after(config, end, t, key)

    begin = state.common().replace(replay=None)  # without the buffer, which the updates do not change
    learnt, rows = jax.lax.scan(updates(replay), begin, jax.random.split(update_key, num_updates))
    learnt = select(warming_up, begin, learnt)
    metrics = select(warming_up, _before_updates(rows), jax.tree.map(jnp.mean, rows))
    metrics |= {"temperature": jnp.exp(learnt.log_temperature)}
    return learnt.replace(environments=state.environments, replay=replay), {**episode_metrics, **metrics}


def _before_updates(rows: Metrics) -> Metrics:
    """The metrics of an iteration whose updates are discarded: NaN, but for the first ``critic_loss``.

    That is the loss of the critics that are kept. NaN would count as a failure of the critics.
    """
    return {name: row[0] if name == "critic_loss" else jnp.full_like(row[0], jnp.nan) for name, row in rows.items()}


def act(
    shared: tuple[PyTree, RunningStatistics, Array], env: AutoReset, env_state: State, key: Key, *, networks: Networks
) -> tuple[State, Transition]:
    """Rollout of one environment. ``shared``: actor parameters, observation statistics, whether actions are random."""
    actor_params, statistics, warming_up = shared

    def policy(obs: Observation, key: Key) -> tuple[Array, dict[str, Array]]:
        distribution = networks.action_distribution(actor_params, statistics, obs)
        chosen = distribution.sample(key)
        random = jax.random.uniform(key, chosen.shape, chosen.dtype, -1.0, 1.0)
        return jnp.where(warming_up, random, chosen), {}

    return rollout(env, env_state, policy, key, horizon=networks.config.horizon, differentiate="none")


def update(
    networks: Networks, replay: Replay, scale: Array | None, state: SACState, key: Key
) -> tuple[SACState, Metrics]:
    """One update of critics, actor, temperature and target network on a batch from the replay buffer.

    Rewards are divided by ``scale``, unless it is None.
    """
    batch_key, next_key, actor_key = jax.random.split(key, 3)
    batch = drawn(networks, replay, scale, state, batch_key)
    state, critic_metrics = critic_update(networks, state, batch, next_key, critic_loss)
    state, actor_metrics = actor_update(networks, state, batch, actor_key, actor_loss)
    return state, {**critic_metrics, **actor_metrics}


def drawn(networks: Networks, replay: Replay, scale: Array | None, state: SACState, key: Key) -> Sample:
    """A batch from the replay buffer with normalised observations. Rewards are divided by ``scale``, unless None."""
    config, statistics = networks.config, state.environments.statistics
    batch = replays.sample(replay, key, config.batch_size, num_steps=config.num_steps, discount=config.discount)
    obs, next_obs = (networks.normalize(statistics, obs) for obs in (batch.obs, batch.next_obs))
    return batch._replace(obs=obs, next_obs=next_obs, reward=batch.reward if scale is None else batch.reward / scale)


def critic_update(
    networks: Networks, state: SACState, batch: Sample, key: Key, loss: Loss, bound: Bound | None = None
) -> tuple[SACState, Metrics]:
    """One optimizer step of the critics, and one update of the target network.

    ``loss`` has the arguments of ``critic_loss``. ``bound`` is applied to the new parameters.
    """
    config = networks.config
    of_params = functools.partial(loss, networks=networks, state=state, batch=batch, key=key)
    grad, metrics = jax.grad(of_params, has_aux=True)(state.critic_params)
    params, opt = networks.update(config.critic_learning_rate, grad, state.critic_opt, state.critic_params)
    params = params if bound is None else bound(params)
    target = optax.incremental_update(params, state.target_params, config.target_rate)
    return state.replace(critic_params=params, critic_opt=opt, target_params=target), metrics


def actor_update(
    networks: Networks, state: SACState, batch: Sample, key: Key, loss: Loss, bound: Bound | None = None
) -> tuple[SACState, Metrics]:
    """One optimizer step of the actor, and one of the temperature; arguments as for ``critic_update``."""
    config = networks.config
    of_params = functools.partial(loss, networks=networks, state=state, batch=batch, key=key)
    grad, metrics = jax.grad(of_params, has_aux=True)(state.actor_params)
    params, opt = networks.update(config.actor_learning_rate, grad, state.actor_opt, state.actor_params)
    state = state.replace(actor_params=params if bound is None else bound(params), actor_opt=opt)
    rate, target = config.temperature_learning_rate, -config.target_entropy_scale * networks.action_size
    state, temperature = update_temperature(networks, state, metrics["entropy"], target=target, learning_rate=rate)
    return state, {**metrics, "actor_grad_norm": optax.tree.norm(grad), **temperature}


def critic_loss(
    params: PyTree, *, networks: Networks, state: SACState, batch: Sample, key: Key
) -> tuple[Array, Metrics]:
    """Mean squared error of all action values. The soft n-step target takes the minimum over the target critics.

    Source: Haarnoja et al. 2018, eq. 5, without its factor 1/2.
    """
    action, log_prob = sampled(networks, state.actor_params, batch.next_obs, key)
    next_value = networks.action_values(state.target_params, batch.next_obs, action).min(axis=-1)
    soft = next_value - jnp.exp(state.log_temperature) * log_prob  # eq. 3
    target = jax.lax.stop_gradient(batch.reward + batch.discount * soft)
    error = networks.action_values(params, batch.obs, batch.action) - target[:, None]
    loss = mean_of_valid(jnp.mean(error**2, axis=-1), batch.valid)
    return loss, {"critic_loss": loss, "value": mean_of_valid(target, batch.valid)}


def actor_loss(
    params: PyTree, *, networks: Networks, state: SACState, batch: Sample, key: Key
) -> tuple[Array, Metrics]:
    """Minus the soft value of actions sampled from the policy. Gradient: reparameterised.

    Source: Haarnoja et al. 2018, eq. 7.
    """
    action, log_prob = sampled(networks, params, batch.obs, key)
    value = networks.action_values(state.critic_params, batch.obs, action).min(axis=-1)
    loss = mean_of_valid(jnp.exp(state.log_temperature) * log_prob - value, batch.valid)
    return loss, {"actor_loss": loss, "entropy": -mean_of_valid(log_prob, batch.valid)}


def sampled(networks: Networks, params: PyTree, normalized: Observation, key: Key) -> tuple[Array, Array]:
    """One action and its log probability for every observation."""
    keys = jax.random.split(key, len(jax.tree.leaves(normalized)[0]))
    return jax.vmap(lambda obs, key: networks.distribution(params, obs).sample_and_log_prob(key))(normalized, keys)


def mean_of_valid(values: Array, valid: Array) -> Array:
    """Mean of the values of valid samples, shape (); 0 if there is none. Both arguments have shape (n,)."""
    return jnp.sum(jnp.where(valid, values, 0.0)) / jnp.maximum(valid.sum(), 1)
