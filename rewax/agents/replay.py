"""A replay buffer on the device: the last steps of all environments, and n-step samples. It is part of the state.

Source: Mnih et al. 2015 (replay); Sutton and Barto 2018, section 7.1 (n-step returns).
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.types import Array, Key, Observation, PyTree


class Step(NamedTuple):
    """One stored control step."""

    obs: Observation
    action: Array
    reward: Array
    next_obs: Observation
    """After the step, before any reset."""
    terminated: Array
    done: Array
    valid: Array


@struct.dataclass
class Replay(struct.Replaceable):
    """The last ``capacity`` steps of every environment.

    Attributes:
      steps: a ``Step`` with leading axes (capacity, num_envs), a ring buffer.
      count: number of steps added so far per environment, shape (), int32.
    """

    steps: Step
    count: Array

    @property
    def capacity(self) -> int:
        return self.steps.reward.shape[0]

    @property
    def num_filled(self) -> Array:
        """Number of stored steps per environment, shape (), int32."""
        return jnp.minimum(self.count, self.capacity)


class Sample(NamedTuple):
    """n-step transitions, leading axis of samples."""

    obs: Observation
    action: Array
    reward: Array
    """Discounted sum of rewards over the steps, (n,)."""
    discount: Array
    """Discount of the value of ``next_obs``: gamma^steps, 0 where the episode terminated, (n,)."""
    next_obs: Observation
    valid: Array
    """False where the first step failed; such a sample must be masked, (n,)."""


def make_replay(step: Step, capacity: int) -> Replay:
    """An empty buffer.

    Args:
      step: an example of one step of all environments, leading axis (num_envs,); arrays or their shapes.
      capacity: steps per environment.
    """
    return Replay(
        steps=jax.tree.map(lambda a: jnp.zeros((capacity, *a.shape), a.dtype), step),
        count=jnp.zeros((), jnp.int32),
    )


def add(replay: Replay, steps: Step) -> Replay:
    """Adds steps with leading axes (T, num_envs) and overwrites the oldest. T must divide the capacity."""
    length = steps.reward.shape[0]
    start = replay.count % replay.capacity

    def write(ring: Array, new: Array) -> Array:
        return jax.lax.dynamic_update_slice_in_dim(ring, new, start, axis=0)

    return Replay(steps=jax.tree.map(write, replay.steps, steps), count=replay.count + length)


def ended(replay: Replay) -> Replay:
    """The buffer whose newest steps are the last of their episodes: what is added next belongs to other ones."""
    newest = (replay.count - 1) % replay.capacity
    return replay.replace(steps=replay.steps._replace(done=replay.steps.done.at[newest].set(True)))


def sample(replay: Replay, key: Key, num_samples: int, *, num_steps: int, discount: float) -> Sample:
    """n-step transitions from uniformly drawn first steps.

    A transition has fewer than n steps where the episode ended, a step failed, or the buffer ends.

    Args:
      replay: a buffer with at least one step.
      key: draws the first steps.
      num_samples: number of transitions.
      num_steps: n.
      discount: gamma [-].

    Returns:
      Transitions with a leading axis of length num_samples. Gradient: none.
    """
    when_key, which_key = jax.random.split(key)
    num_envs = replay.steps.reward.shape[1]
    oldest = replay.count - replay.num_filled
    start = oldest + jax.random.randint(when_key, (num_samples,), 0, replay.num_filled)
    env = jax.random.randint(which_key, (num_samples,), 0, num_envs)

    def at(when: Array) -> Step:
        return jax.tree.map(lambda a: a[when % replay.capacity, env], replay.steps)

    def follow(carry: tuple[Array, Array, Array, Array], k: Array):
        reward, weight, alive, last = carry
        here = jax.tree.map(lambda a: a[(start + k) % replay.capacity, env], replay.steps._replace(obs={}, next_obs={}))
        counts = alive & (start + k < replay.count) & here.valid
        reward = reward + jnp.where(counts, weight * here.reward, 0.0)
        weight = jnp.where(counts, weight * discount, weight)
        return (reward, weight, counts & ~here.done, jnp.where(counts, start + k, last)), None

    zero = jnp.zeros(num_samples, replay.steps.reward.dtype)
    begin = (zero, jnp.ones_like(zero), jnp.ones(num_samples, bool), start)
    (reward, weight, _, last), _ = jax.lax.scan(follow, begin, jnp.arange(num_steps))
    first, end = at(start), at(last)
    return Sample(
        obs=first.obs,
        action=first.action,
        reward=reward,
        discount=jnp.where(end.terminated, 0.0, weight),
        next_obs=end.next_obs,
        valid=first.valid,
    )


def return_scale(replay: Replay, discount: float, limit: float = math.inf) -> Array:
    """Root mean square of the discounted returns from every stored step to the end of its episode, shape ().

    It is at least the largest size of a return divided by ``limit``: divided by the scale, no return exceeds the limit.
    A return also ends at the newest step, and at the last place of the full ring, although the step after it in time is
    in the first place. Failed steps are masked. If all rewards are zero, the scale is 1.
    """
    steps, position = replay.steps, jnp.arange(replay.capacity)
    newest = (replay.count - 1) % replay.capacity
    ends = steps.done | ~steps.valid | (position == newest)[:, None]

    def earlier(following: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        reward, end = step
        value = reward + jnp.where(end, 0.0, discount * following)
        return value, value

    reward = jnp.where(steps.valid, steps.reward, 0.0)
    _, returns = jax.lax.scan(
        earlier, jnp.zeros(reward.shape[1:], reward.dtype), (reward, ends), reverse=True, unroll=8
    )
    there = steps.valid & (position < replay.count)[:, None]
    scale = jnp.sqrt(jnp.mean(returns**2, where=there))
    if limit < math.inf:
        scale = jnp.maximum(scale, jnp.max(jnp.abs(returns), where=there, initial=0.0) / limit)
    return jnp.where(scale > 0.0, scale, 1.0)  # a comparison with NaN is false


def bytes_of(step: PyTree, capacity: int) -> int:
    """Memory of a buffer with ``capacity`` steps per environment [bytes]."""
    return capacity * sum(a.size * a.dtype.itemsize for a in jax.tree.leaves(step))
