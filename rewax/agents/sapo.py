"""SAPO, soft analytic policy optimization: maximum-entropy first-order reinforcement learning.

One iteration: every environment acts for a short horizon; the soft return of that stretch plus the soft value at its
end is differentiated through the simulation into the actor; temperature and critics follow.

Source: Xing, Luk and Oh 2025, "Stabilizing Reinforcement Learning in Differentiable Multiphysics Simulation"
(ICLR 2025), with these corrections of its code: the bootstrap is V(s_{t+1}) always, a reset cuts the gradient of its
own environment only, the gradient norm is clipped over everything an optimizer updates, and an environment whose
gradient is not finite is left out and counted.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax

from rewax import struct
from rewax.agents.base import Agent, Metrics
from rewax.agents.distributions import TanhNormal
from rewax.agents.networks import ACTIVATIONS, Critics, Encoder, GaussianActor
from rewax.agents.normalization import RunningStatistics, init_statistics, normalize, update_statistics
from rewax.agents.returns import short_horizon_return, td_lambda
from rewax.agents.rollout import Differentiation, Transition, rollout
from rewax.envs.base import Env, State
from rewax.envs.wrappers import AutoReset
from rewax.status import Status, all_finite
from rewax.types import Array, Key, Observation, PyTree


@dataclasses.dataclass(frozen=True)
class SAPOConfig:
    """Hyper-parameters; the defaults are the paper's for the deformable tasks.

    Attributes:
      num_envs: environments side by side.
      horizon: control steps per iteration and environment.
      num_iterations: iterations over which the learning rates fall linearly to ``final_learning_rate``.
      discount: gamma [-].
      td_lambda: lambda of the critics' targets [-].
      actor_learning_rate, critic_learning_rate, final_learning_rate: of AdamW.
      temperature_learning_rate: of AdamW on the logarithm of the temperature, constant.
      adam_b1, adam_b2, weight_decay: of all three optimizers.
      max_grad_norm: global norm to which each optimizer's gradient is clipped.
      initial_temperature: alpha at the start; fixed at it if ``learn_temperature`` is off.
      learn_temperature: adapt alpha to the target entropy.
      target_entropy_scale: the target entropy is minus this times the number of action components.
      entropy_in_return, entropy_in_targets: the two places of the entropy bonus (the paper's ablations).
      critic_passes, critic_minibatches: how often each iteration's data is used, in how many contiguous parts.
      critic_chunk: samples of a minibatch that are differentiated at a time, their gradients added up; the update is
        the same but for rounding. None: all on an accelerator, as many as fit its cache on a CPU.
      num_critics: independent value heads; the actor sees their mean, targets use their minimum.
      actor_widths, critic_widths, point_widths, point_features, vector_features: network sizes.
      activation: ``silu``, ``elu``, ``relu`` or ``tanh``.
      log_std_range: clamp of the log standard deviation.
      initial_log_std: added to the log standard deviation's bias at the start; 0 gives sigma near 1.
      normalize_observations: running normalisation of vector observations.
      stagger_episodes: start environments at random points of their time limit, so that they do not reset together.
      differentiate: how the rollout is differentiated, see ``rewax.agents.rollout``.
    """

    num_envs: int = 32
    horizon: int = 32
    num_iterations: int = 4000
    discount: float = 0.99
    td_lambda: float = 0.95
    actor_learning_rate: float = 2e-3
    critic_learning_rate: float = 5e-4
    final_learning_rate: float = 1e-5
    temperature_learning_rate: float = 5e-3
    adam_b1: float = 0.7
    adam_b2: float = 0.95
    weight_decay: float = 0.01
    max_grad_norm: float = 0.5
    initial_temperature: float = 1.0
    learn_temperature: bool = True
    target_entropy_scale: float = 0.5
    entropy_in_return: bool = True
    entropy_in_targets: bool = True
    critic_passes: int = 16
    critic_minibatches: int = 4
    critic_chunk: int | None = None
    num_critics: int = 2
    actor_widths: tuple[int, ...] = (512, 256)
    critic_widths: tuple[int, ...] = (256, 256)
    point_widths: tuple[int, ...] = (64, 128, 256)
    point_features: int = 64
    vector_features: int = 128
    activation: Literal["silu", "elu", "relu", "tanh"] = "silu"
    log_std_range: tuple[float, float] = (-5.0, 2.0)
    initial_log_std: float = 0.0
    normalize_observations: bool = True
    stagger_episodes: bool = False
    differentiate: Differentiation = "checkpointed"

    def __post_init__(self) -> None:
        for name in ("num_envs", "horizon", "num_iterations", "critic_passes", "critic_minibatches", "num_critics"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: give a number of at least 1")
        for name in ("discount", "td_lambda"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}: give a number between 0 and 1")
        for name in ("actor_learning_rate", "critic_learning_rate", "initial_temperature", "max_grad_norm"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}: give a positive number")
        if (self.num_envs * self.horizon) % self.critic_minibatches:
            raise ValueError(
                f"critic_minibatches is {self.critic_minibatches}, which does not divide num_envs * horizon = "
                f"{self.num_envs * self.horizon}: choose a divisor"
            )
        minibatch = self.num_envs * self.horizon // self.critic_minibatches
        if self.critic_chunk is not None and (self.critic_chunk < 1 or minibatch % self.critic_chunk):
            raise ValueError(
                f"critic_chunk is {self.critic_chunk}, which does not divide a minibatch of {minibatch} samples "
                "(num_envs * horizon / critic_minibatches): choose a divisor, or None"
            )


@struct.dataclass
class SAPOState:
    """Everything a run is; a checkpoint holds just this."""

    actor_params: PyTree
    critic_params: PyTree
    log_temperature: Array
    actor_opt: PyTree
    critic_opt: PyTree
    temperature_opt: PyTree
    statistics: RunningStatistics
    env_state: State
    episode_return: Array
    key: Key
    iteration: Array
    env_steps: Array


class _Parts(NamedTuple):
    """What is fixed once environment and configuration are known."""

    env: AutoReset
    config: SAPOConfig
    actor: GaussianActor
    critics: Critics
    actor_optimizer: optax.GradientTransformation
    critic_optimizer: optax.GradientTransformation
    temperature_optimizer: optax.GradientTransformation
    target_entropy: float
    critic_chunk: int


class _Rollout(NamedTuple):
    """One environment's stretch, with what the critics' update needs."""

    state: State
    transitions: Transition
    next_values: Array
    """Value of every next observation by every critic, shape (T, num_critics)."""


def make_sapo(env: Env, config: SAPOConfig | None = None) -> Agent:
    """SAPO on an environment.

    Args:
      env: one environment, without auto-reset.
      config: hyper-parameters.

    Returns:
      ``init(key)``, ``train_step(state)`` and ``policy(state, obs, key, deterministic=False)``.
    """
    parts = _make_parts(env, SAPOConfig() if config is None else config)

    def policy(state: SAPOState, obs: Observation, key: Key, deterministic: bool = False) -> Array:
        distribution = _action_distribution(parts, state.actor_params, state.statistics, obs)
        return distribution.mode() if deterministic else distribution.sample(key)

    return Agent(
        init=jax.jit(lambda key: _init(parts, key)),
        train_step=jax.jit(lambda state: _train_step(parts, state)),
        policy=policy,
    )


def _make_parts(env: Env, config: SAPOConfig) -> _Parts:
    action_size = env.action_spec.shape[0]
    activation, gain = ACTIVATIONS[config.activation], 1.0

    def encoder() -> Encoder:
        return Encoder(config.point_widths, config.point_features, config.vector_features, activation, gain)

    def optimizer(schedule: optax.ScalarOrSchedule) -> optax.GradientTransformation:
        return optax.chain(
            optax.clip_by_global_norm(config.max_grad_norm),
            optax.scale_by_adam(config.adam_b1, config.adam_b2),
            optax.add_decayed_weights(config.weight_decay),
            optax.scale_by_learning_rate(schedule),
        )

    def falling(learning_rate: float, updates_per_iteration: int) -> optax.Schedule:
        schedule = optax.linear_schedule(learning_rate, config.final_learning_rate, config.num_iterations)
        return lambda count: schedule(jnp.asarray(count) // updates_per_iteration)

    return _Parts(
        env=AutoReset(env=env),
        config=config,
        actor=GaussianActor(
            encoder(), config.actor_widths, action_size, activation, gain, config.log_std_range, config.initial_log_std
        ),
        critics=Critics(encoder(), config.critic_widths, config.num_critics, activation, gain),
        actor_optimizer=optimizer(falling(config.actor_learning_rate, 1)),
        critic_optimizer=optimizer(
            falling(config.critic_learning_rate, config.critic_passes * config.critic_minibatches)
        ),
        temperature_optimizer=optimizer(config.temperature_learning_rate),
        target_entropy=-config.target_entropy_scale * action_size,
        critic_chunk=_critic_chunk(config, env),
    )


_CACHED_POINTS = 4096
"""Observed points whose activations stay in a CPU's cache; at 64,000 a critic's gradient takes twice as long each."""


def _critic_chunk(config: SAPOConfig, env: Env) -> int:
    """Samples that the critics differentiate at a time: a divisor of the minibatch."""
    minibatch = config.num_envs * config.horizon // config.critic_minibatches
    if config.critic_chunk is not None:
        return config.critic_chunk
    if jax.default_backend() != "cpu":
        return minibatch
    points = max((box.shape[0] for box in env.observation_spec.values() if len(box.shape) == 2), default=1)
    return max(n for n in range(1, minibatch + 1) if minibatch % n == 0 and (n == 1 or n * points <= _CACHED_POINTS))


def _init(parts: _Parts, key: Key) -> SAPOState:
    env, config = parts.env, parts.config
    key, actor_key, critic_key, env_key, stagger_key = jax.random.split(key, 5)
    env_state = jax.vmap(env.reset)(jax.random.split(env_key, config.num_envs))
    episode_return = jnp.zeros(config.num_envs)
    if config.stagger_episodes:
        start = jax.random.randint(stagger_key, (config.num_envs,), 0, env.episode_length, jnp.int32)
        env_state = env_state.replace(step_count=start)
        # A first episode that is cut short has no return that compares with the others'.
        episode_return = jnp.where(start > 0, jnp.nan, episode_return)
    obs = jax.tree.map(lambda a: a[0], env_state.obs)
    actor_params = parts.actor.init(actor_key, obs)
    critic_params = parts.critics.init(critic_key, obs)
    log_temperature = jnp.log(jnp.asarray(config.initial_temperature))
    statistics = init_statistics(env.observation_spec)
    if config.normalize_observations:
        statistics = update_statistics(statistics, env_state.obs)
    state = SAPOState(
        actor_params=actor_params,
        critic_params=critic_params,
        log_temperature=log_temperature,
        actor_opt=parts.actor_optimizer.init(actor_params),
        critic_opt=parts.critic_optimizer.init(critic_params),
        temperature_opt=parts.temperature_optimizer.init(log_temperature),
        statistics=statistics,
        env_state=env_state,
        episode_return=episode_return,
        key=key,
        iteration=jnp.zeros((), jnp.int32),
        env_steps=jnp.zeros((), jnp.int32),
    )
    # Python scalars leave weak types behind, with which train_step would be compiled once more for its own output.
    return jax.tree.map(_strongly_typed, state)


def _strongly_typed(a: Array) -> Array:
    return jax.lax.convert_element_type(a, a.dtype) if jnp.issubdtype(a.dtype, jnp.number) else a


def _train_step(parts: _Parts, state: SAPOState) -> tuple[SAPOState, Metrics]:
    config = parts.config
    key, rollout_key = jax.random.split(state.key)
    keys = jax.random.split(rollout_key, config.num_envs)

    # Actor: one gradient per environment, so that one bad environment can be left out.
    loss_and_grad = jax.value_and_grad(_actor_loss, argnums=1, has_aux=True)
    (losses, data), grads = jax.vmap(
        lambda env_state, key: loss_and_grad(parts, state.actor_params, state, env_state, key)
    )(state.env_state, keys)
    data = jax.lax.stop_gradient(data)
    grad, kept = _mean_of_finite(losses, grads)
    updates, actor_opt = parts.actor_optimizer.update(grad, state.actor_opt, state.actor_params)
    actor_params = optax.apply_updates(state.actor_params, updates)

    entropy = data.transitions.extras["entropy"]
    log_temperature, temperature_opt = _update_temperature(parts, state, entropy.mean(axis=1))
    critic_params, critic_opt, critic_metrics = _update_critics(parts, state, data, jnp.exp(log_temperature))

    statistics = state.statistics
    if config.normalize_observations:
        statistics = update_statistics(statistics, data.transitions.obs)
    episode_return, finished_return = _episode_returns(state.episode_return, data.transitions)
    new = SAPOState(
        actor_params=actor_params,
        critic_params=critic_params,
        log_temperature=log_temperature,
        actor_opt=actor_opt,
        critic_opt=critic_opt,
        temperature_opt=temperature_opt,
        statistics=statistics,
        env_state=data.state,
        episode_return=episode_return,
        key=key,
        iteration=state.iteration + 1,
        env_steps=state.env_steps + config.num_envs * config.horizon,
    )
    failed = (data.transitions.status & int(Status.NAN)) != 0
    metrics = {
        "return": finished_return,
        "reward": data.transitions.reward.mean(),
        "entropy": entropy.mean(),
        "temperature": jnp.exp(log_temperature),
        "actor_loss": jnp.sum(jnp.where(kept, losses, 0.0)) / jnp.maximum(kept.sum(), 1),
        "actor_grad_norm": optax.tree.norm(grad),
        **critic_metrics,
        "dropped_gradients": jnp.sum(~kept),
        "failed_episodes": jnp.sum(failed),
        **{f"env/{name}": value.mean() for name, value in data.transitions.metrics.items()},
    }
    return new, metrics


def _action_distribution(
    parts: _Parts, actor_params: PyTree, statistics: RunningStatistics, obs: Observation
) -> TanhNormal:
    out: Any = parts.actor.apply(actor_params, normalize(statistics, obs))
    return TanhNormal(mean=out[0], log_std=out[1])


def _values(parts: _Parts, critic_params: PyTree, normalized_obs: Observation) -> Array:
    """By all critics, for observations with one leading axis, shape (T, num_critics)."""
    out: Any = jax.vmap(lambda obs: parts.critics.apply(critic_params, obs))(normalized_obs)
    return out


def _normalized_entropy(parts: _Parts, entropy: Array) -> Array:
    """0 at the target entropy, 1 at minus the target entropy."""
    size = -parts.target_entropy
    return (entropy + size) * (0.5 / size)


def _actor_loss(
    parts: _Parts, actor_params: PyTree, state: SAPOState, env_state: State, key: Key
) -> tuple[Array, _Rollout]:
    """Minus the soft return per step of one environment's stretch."""
    config = parts.config

    def policy(obs: Observation, key: Key) -> tuple[Array, dict[str, Array]]:
        distribution = _action_distribution(parts, actor_params, state.statistics, obs)
        action_key, entropy_key = jax.random.split(key)
        # A fresh sample, independent of the action that is taken.
        _, log_prob = distribution.sample_and_log_prob(entropy_key)
        return distribution.sample(action_key), {"entropy": -log_prob}

    final_state, transitions = rollout(
        parts.env, env_state, policy, key, horizon=config.horizon, differentiate=config.differentiate
    )
    next_values = _values(parts, state.critic_params, normalize(state.statistics, transitions.next_obs))
    reward = transitions.reward
    if config.entropy_in_return:
        reward = reward + jnp.exp(state.log_temperature) * _normalized_entropy(parts, transitions.extras["entropy"])
    value = jnp.where(transitions.terminated, 0.0, next_values.mean(axis=-1))
    done = transitions.terminated | transitions.truncated
    objective = short_horizon_return(reward, value, done, discount=config.discount)
    return -objective / config.horizon, _Rollout(final_state, transitions, next_values)


def _mean_of_finite(losses: Array, grads: PyTree) -> tuple[PyTree, Array]:
    """Mean gradient over the environments whose loss and gradient are finite, and which those are, shape (envs,)."""
    kept = jax.vmap(all_finite)((losses, grads))
    count = jnp.maximum(kept.sum(), 1)

    def mean(g: Array) -> Array:
        mask = kept.reshape(-1, *[1] * (g.ndim - 1))
        return jnp.sum(jnp.where(mask, g, 0.0), axis=0) / count

    return jax.tree.map(mean, grads), kept


def _update_temperature(parts: _Parts, state: SAPOState, entropy: Array) -> tuple[Any, PyTree]:
    """One step towards the target entropy; entropy: mean over each environment's stretch, shape (envs,)."""
    if not parts.config.learn_temperature:
        return state.log_temperature, state.temperature_opt
    surplus = jnp.mean(entropy) - parts.target_entropy

    def loss(log_temperature: Array) -> Array:
        return jnp.exp(log_temperature) * -parts.target_entropy * surplus

    grad = jax.grad(loss)(state.log_temperature)
    grad = jnp.where(jnp.isfinite(grad), grad, 0.0)
    update, opt = parts.temperature_optimizer.update(grad, state.temperature_opt, state.log_temperature)
    return optax.apply_updates(state.log_temperature, update), opt


def _update_critics(
    parts: _Parts, state: SAPOState, data: _Rollout, temperature: Array
) -> tuple[PyTree, PyTree, Metrics]:
    """Regress all critics onto TD(lambda) targets, several passes over contiguous minibatches in order of time."""
    config, transitions = parts.config, data.transitions
    reward = transitions.reward
    if config.entropy_in_targets:
        reward = reward + temperature * _normalized_entropy(parts, transitions.extras["entropy"])
    value = jnp.where(transitions.terminated, 0.0, data.next_values.min(axis=-1))
    done = transitions.terminated | transitions.truncated
    targets = jax.vmap(lambda r, v, d: td_lambda(r, v, d, discount=config.discount, lambda_=config.td_lambda))(
        reward, value, done
    )
    obs = normalize(state.statistics, transitions.obs)

    def minibatches(a: Array) -> Array:
        by_time = jnp.swapaxes(a, 0, 1)
        return by_time.reshape(config.critic_minibatches, -1, parts.critic_chunk, *a.shape[2:])

    batches = jax.tree.map(minibatches, (obs, targets))

    def loss(params: PyTree, obs: Observation, target: Array) -> Array:
        return jnp.mean((_values(parts, params, obs) - target[:, None]) ** 2)

    def update(carry: tuple[PyTree, PyTree], batch: tuple[Observation, Array]):
        params, opt = carry
        value, grad = _mean_over_chunks(lambda obs, target: jax.value_and_grad(loss)(params, obs, target), batch)
        grad = jax.tree.map(lambda g: jnp.where(jnp.isfinite(g), g, 0.0), grad)
        updates, opt = parts.critic_optimizer.update(grad, opt, params)
        return (optax.apply_updates(params, updates), opt), (value, optax.tree.norm(grad))

    def one_pass(carry: tuple[PyTree, PyTree], _: None):
        return jax.lax.scan(update, carry, batches)

    (params, opt), (losses, norms) = jax.lax.scan(
        one_pass, (state.critic_params, state.critic_opt), None, length=config.critic_passes
    )
    return params, opt, {"critic_loss": losses[-1].mean(), "critic_grad_norm": norms.mean(), "value": value.mean()}


def _mean_over_chunks(function: Callable[..., PyTree], chunks: tuple[PyTree, ...]) -> PyTree:
    """Mean of ``function(*chunk)`` over the leading axis of all arrays in ``chunks``, one chunk after the other."""
    first = jax.tree.map(lambda a: a[0], chunks)
    count = len(jax.tree.leaves(chunks)[0])

    def add(total: PyTree, chunk: tuple[PyTree, ...]) -> tuple[PyTree, None]:
        return jax.tree.map(jnp.add, total, function(*chunk)), None

    if count == 1:
        return function(*first)
    zeros = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(function, *first))
    return jax.tree.map(lambda a: a / count, jax.lax.scan(add, zeros, chunks)[0])


def _episode_returns(running: Array, transitions: Transition) -> tuple[Array, Array]:
    """Returns of the episodes under way, and the mean of those that ended (NaN if none did)."""

    def step(carry: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
        reward, done = inputs
        total = carry + reward
        return jnp.where(done, 0.0, total), jnp.where(done, total, jnp.nan)

    done = transitions.terminated | transitions.truncated
    running, finished = jax.lax.scan(step, running, (transitions.reward.T, done.T))
    return running, jnp.nanmean(finished)
