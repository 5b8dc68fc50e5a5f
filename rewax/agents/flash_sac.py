"""FlashSAC: SAC with few updates on large batches, whose weights, rewards and values are bounded.

Source: Kim et al. 2026, "FlashSAC: Fast and Stable Off-Policy Reinforcement Learning for High-Dimensional Robot
Control" (arXiv 2604.04539). What it adds to ``rewax.agents.sac``:

- Each critic gives probabilities of equidistant values, and learns by the cross entropy with those of the target.
- Rewards are divided so that discounted returns have the size 1, and none exceeds the largest value.
- After every update the weights of each output of a linear layer have norm 1, and the scales and offsets of a LayerNorm
  together the norm of a vector of ones.
- The actor and the temperature are updated once in several updates of the critics.
- While it explores, the noise of an action is held for some steps.

Differences from theirs:

- The networks are those of our SAC, which take point clouds and pictures, with LayerNorm. Theirs are residual blocks
  with batch normalisation, whose results depend on the other samples of a batch.
- Linear layers have a bias without a bound.
- Learning rates are constant; theirs fall to a half.
- Returns are those in the replay buffer, theirs all since the beginning; their size is the root mean square, theirs
  the standard deviation.
- Each environment holds its noise for its own number of steps, at most to the end of a rollout.
- The standard deviation of the policy is clipped as in our SAC, not squashed.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Annotated, Any, TypeAlias

import jax
import jax.numpy as jnp

from rewax.agents import replay as replays
from rewax.agents import sac
from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import ReplayConfig, no_memory
from rewax.agents.legal import AT_LEAST_2, Count, Positive, Share
from rewax.agents.normalization import RunningStatistics
from rewax.agents.replay import Replay, Sample
from rewax.agents.rollout import Transition, rollout
from rewax.agents.sac import SACState
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, Observation, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class FlashSACConfig(ReplayConfig):
    """Hyper-parameters beyond those of ``ReplayConfig``. Learning rates are constant: ``final_learning_rate`` and
    ``num_iterations`` have no effect on them.

    Attributes:
      updates: updates of the critics per iteration, a multiple of ``actor_period``.
      normalize_rewards: divide rewards as above. Without it, give a ``value_limit`` that fits the task's returns.
      num_values: number of values of the critics.
      value_limit: the values lie between minus this and this.
      actor_period: updates of the critics per update of actor and temperature.
      longest_noise: largest number n of steps for which noise is held; the probability of n is proportional to 1 / n^2.
      target_entropy_scale: see ``SAPOConfig``. 0.478 is that of a normal distribution with the standard deviation 0.15.
    """

    actor_learning_rate: float = 3e-4
    final_learning_rate: float = 3e-4
    critic_learning_rate: float = 3e-4
    adam_b1: float = 0.9
    adam_b2: float = 0.999
    observation_clip: float | None = 5.0
    memory: Annotated[int, no_memory("FlashSAC learns from single transitions")] = 0
    temperature_learning_rate: Positive = 3e-4
    initial_temperature: Positive = 0.01
    target_entropy_scale: Positive = 0.478
    batch_size: Count = 2048
    target_rate: Share = 0.01
    normalize_rewards: bool = True
    num_values: Annotated[int, AT_LEAST_2] = 101
    value_limit: Positive = 5.0
    actor_period: Count = 2
    longest_noise: Count = 16

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.updates % self.actor_period:
            raise ValueError(
                f"updates is {self.updates}, no multiple of actor_period = {self.actor_period}: give a multiple, "
                "because the actor is updated once in actor_period updates of the critics"
            )

    @property
    def values(self) -> Array:
        """The values whose probabilities the critics give, shape (num_values,)."""
        return jnp.linspace(-self.value_limit, self.value_limit, self.num_values)


Networks: TypeAlias = ActorCritic[FlashSACConfig]


def make_flash_sac(env: Env, config: FlashSACConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """FlashSAC on an environment; arguments as for ``rewax.agents.actor_critic.actor_agent``.

    ``train_step`` consumes its input, because it changes the replay buffer in place.
    """
    config = FlashSACConfig.given(config)
    return actor_agent("flash_sac", env, config, init=init, train_step=train_step, randomize=randomize, donate=True)


def _networks(env: Env, config: FlashSACConfig) -> Networks:
    return make_actor_critic(env, config, num_outputs=config.num_values)


def init(config: FlashSACConfig, leaves: EnvLeaves, key: Key) -> SACState:
    """The first state of a run."""
    state = sac.start(_networks(leaves.first(), config), leaves, key)
    critic_params = bounded(state.critic_params)
    return state.replace(
        actor_params=bounded(state.actor_params), critic_params=critic_params, target_params=critic_params
    )


def train_step(config: FlashSACConfig, state: SACState) -> tuple[SACState, Metrics]:
    """One iteration: act, add to the replay buffer, update."""
    networks = _networks(state.environments.env.first(), config)

    def updates(replay: Replay) -> sac.Update:
        scale = None
        if config.normalize_rewards:
            scale = replays.return_scale(replay, config.discount, config.value_limit)
        return functools.partial(update, networks, replay, scale)

    return sac.iterate(networks, state, act, updates, config.updates // config.actor_period)


def act(
    shared: tuple[PyTree, RunningStatistics, Array], env: AutoReset, env_state: State, key: Key, *, networks: Networks
) -> tuple[State, Transition]:
    """Rollout of one environment with noise that is held; arguments as for ``rewax.agents.sac.act``."""
    (actor_params, statistics, warming_up), config = shared, networks.config
    noise_key, key = jax.random.split(key)

    def policy(obs: Observation, key: Key, noise: Array) -> tuple[Array, dict[str, Array]]:
        distribution = networks.action_distribution(actor_params, statistics, obs)
        chosen = jnp.tanh(distribution.mean + jnp.exp(distribution.log_std) * noise)
        random = jax.random.uniform(key, chosen.shape, chosen.dtype, -1.0, 1.0)
        return jnp.where(warming_up, random, chosen), {}

    noise = held_noise(noise_key, config.horizon, networks.action_size, config.longest_noise)
    return rollout(env, env_state, policy, key, horizon=config.horizon, differentiate="none", inputs=noise)


def held_noise(key: Key, num_steps: int, size: int, longest: int) -> Array:
    """Standard normal noise, each held for n steps, shape (num_steps, size).

    The probability of n, from 1 to ``longest``, is proportional to 1 / n^2, but for the last noise, which ends with the
    sequence.
    """
    number_key, noise_key = jax.random.split(key)
    weights = -2.0 * jnp.log(jnp.arange(1.0, longest + 1.0))
    numbers = 1 + jax.random.categorical(number_key, weights, shape=(num_steps,))
    noise = jax.random.normal(noise_key, (num_steps, size))

    def step(carry: tuple[Array, Array], new: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
        (left, held), (number, noise) = carry, new
        held = jnp.where(left == 0, noise, held)
        return (jnp.where(left == 0, number, left) - 1, held), held

    return jax.lax.scan(step, (jnp.zeros_like(numbers[0]), noise[0]), (numbers, noise))[1]


def update(
    networks: Networks, replay: Replay, scale: Array | None, state: SACState, key: Key
) -> tuple[SACState, Metrics]:
    """One update of actor and temperature, and ``actor_period`` updates of critics and target network.

    Each update of the critics has a batch of its own. Rewards are divided by ``scale``, unless it is None.
    """
    metrics: Metrics = {}
    for i, one in enumerate(jax.random.split(key, networks.config.actor_period)):
        batch_key, next_key, actor_key = jax.random.split(one, 3)
        batch = sac.drawn(networks, replay, scale, state, batch_key)
        if i == 0:
            state, metrics = sac.actor_update(networks, state, batch, actor_key, actor_loss, bounded)
        state, of_critics = sac.critic_update(networks, state, batch, next_key, critic_loss, bounded)
        metrics = {**metrics, **of_critics}
    return state, metrics


def critic_loss(
    params: PyTree, *, networks: Networks, state: SACState, batch: Sample, key: Key
) -> tuple[Array, Metrics]:
    """Mean cross entropy of all critics with the soft n-step target.

    The target moves the values of the target critic whose mean is the smallest, and gives their probabilities to the
    nearest values.

    Source: Bellemare, Dabney and Munos 2017, "A Distributional Perspective on Reinforcement Learning", algorithm 1.
    """
    values = networks.config.values
    action, log_prob = sac.sampled(networks, state.actor_params, batch.next_obs, key)
    next_logits = networks.action_values(state.target_params, batch.next_obs, action)
    probabilities = smallest(jax.nn.softmax(next_logits), values)
    soft = values - (jnp.exp(state.log_temperature) * log_prob)[:, None]
    moved = batch.reward[:, None] + batch.discount[:, None] * soft
    target = jax.lax.stop_gradient(projected(probabilities, moved, values))
    log_probabilities = jax.nn.log_softmax(networks.action_values(params, batch.obs, batch.action))
    entropy = -jnp.sum(target[:, None] * log_probabilities, axis=-1)
    loss = sac.mean_of_valid(jnp.mean(entropy, axis=-1), batch.valid)
    return loss, {"critic_loss": loss, "value": sac.mean_of_valid(target @ values, batch.valid)}


def actor_loss(
    params: PyTree, *, networks: Networks, state: SACState, batch: Sample, key: Key
) -> tuple[Array, Metrics]:
    """Minus the soft value of actions sampled from the policy. Gradient: reparameterised."""
    action, log_prob = sac.sampled(networks, params, batch.obs, key)
    probabilities = jax.nn.softmax(networks.action_values(state.critic_params, batch.obs, action))
    value = jnp.min(probabilities @ networks.config.values, axis=-1)
    loss = sac.mean_of_valid(jnp.exp(state.log_temperature) * log_prob - value, batch.valid)
    return loss, {"actor_loss": loss, "entropy": -sac.mean_of_valid(log_prob, batch.valid)}


def smallest(probabilities: Array, values: Array) -> Array:
    """Of several critics, the probabilities whose mean value is the smallest.

    Args:
      probabilities: shape (n, num_critics, num_values).
      values: shape (num_values,).

    Returns:
      Shape (n, num_values). Gradient: with respect to those probabilities.
    """
    which = jnp.argmin(probabilities @ values, axis=-1)
    return jnp.take_along_axis(probabilities, which[:, None, None], axis=1)[:, 0]


def projected(probabilities: Array, moved: Array, values: Array) -> Array:
    """Probabilities of equidistant values with the mean of other values that have given probabilities.

    Each probability goes to the two values on both sides, in proportion to their nearness. Beyond the smallest and the
    largest value all goes to that one, and the mean is another one.

    Args:
      probabilities: of the other values, shape (n, num_values).
      moved: the other values, shape (n, num_values).
      values: equidistant, shape (num_values,).

    Returns:
      Shape (n, num_values).
    """
    place = (jnp.clip(moved, values[0], values[-1]) - values[0]) / (values[1] - values[0])
    below = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, len(values) - 2)
    share = place - below  # of the value above

    def one(probabilities: Array, below: Array, share: Array) -> Array:
        new = jnp.zeros_like(probabilities).at[below].add(probabilities * (1.0 - share))
        return new.at[below + 1].add(probabilities * share)

    return jax.vmap(one)(probabilities, below, share)


def bounded(params: PyTree) -> PyTree:
    """Parameters of a flax module with weights of norm 1.

    Each column of a ``kernel`` has norm 1, and ``scale`` and ``bias`` of a LayerNorm of n features together norm
    sqrt(n). Other parameters stay.
    """
    if not isinstance(params, Mapping):
        return params
    new: dict[str, Any] = {name: bounded(part) for name, part in params.items()}
    if "kernel" in new:
        new["kernel"] = new["kernel"] / jnp.maximum(jnp.linalg.norm(new["kernel"], axis=0), 1e-8)
    if "scale" in new:
        size = jnp.sqrt(jnp.sum(new["scale"] ** 2) + jnp.sum(new["bias"] ** 2)) / math.sqrt(new["scale"].size)
        new |= {name: new[name] / jnp.maximum(size, 1e-8) for name in ("scale", "bias")}
    return new
