"""Latency: delays of observations and actions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.base import ArraySpec, State
from rewax.envs.kit.checks import checked_action
from rewax.envs.wrappers import _Wrapper, check_began, check_inside, count_inside, forwarded, observed_names
from rewax.physics.numerics.clipping import clipped
from rewax.types import Array, Key, Observation, PyTree

_STREAM = 0x1A7E
"""Folded into a state's key: delays use a separate random stream, so they do not change the randomness of physics."""

Steps = int | tuple[int, int]
"""A number of control steps, or the lowest and the highest of a range."""


@struct.dataclass
class InFlight(struct.Replaceable):
    """Buffers of delayed observations and actions; ``Latency`` stores them in ``State.delayed``.

    Attributes:
      observations: the last observations by name, the newest first, shape (longest delay + 1, *shape).
      actions: the last actions, the newest first, shape (longest delay, *action_shape).
      observation_delay, action_delay: delays in this episode [control steps], shape (), int32.
      inner: ``State.delayed`` of the wrapped environment.
    """

    observations: Observation
    actions: Array
    observation_delay: Array
    action_delay: Array
    inner: PyTree = None


@struct.dataclass
class Latency(struct.Replaceable, _Wrapper):
    """An environment whose observations and actions are delayed by whole control steps.

    With ``observation=2`` a policy gets the observation of two control steps ago, and in the first two steps the first
    observation. With ``action=1`` an action acts one control step later; in the first step the action is 0. With a
    range, ``action=(0, 2)``, each episode draws a delay, both ends included. Rewards, physics and random numbers are
    those of ``env``.

    Attributes:
      env: an environment. ``Latency`` goes around ``Sensing``, not inside.
      observation: delay of observations [control steps] (static).
      action: delay of actions [control steps] (static).
      of: names of the observations that are delayed; None: all. Leave out observations that only critics use (static).

    Example:
      >>> env = Latency(env=Sensing(env=make("RollingFlat"), sensors={"depth": camera}), observation=(0, 2), action=1)

    Gradient: exact. It flows from the step in which an action acts to the action, and from a delayed observation to the
      state that it shows. None flows from a new episode to the old one.

    Raises:
      ValueError: a delay is no integer of at least 0 and no range of them, or as long as an episode; ``of`` has an
        unknown name; or the wrapper is around ``AutoReset`` or a batch. ``step``: the state is that of ``env`` alone.
    """

    observation: Steps = struct.static_field(default=0)
    action: Steps = struct.static_field(default=0)
    of: tuple[str, ...] | None = struct.static_field(default=None)

    def __post_init__(self) -> None:
        check_inside(self)
        for name in ("observation", "action"):
            steps, most = _checked(name, getattr(self, name)), self.episode_length
            if _longest(steps) >= most:
                raise ValueError(
                    f"{name} of the latency is {steps}, but an episode has {most} control steps: give fewer"
                )
            object.__setattr__(self, name, steps)
        object.__setattr__(self, "of", observed_names(self.env, self.of))

    def reset(self, key: Key) -> State:
        state = self.env.reset(key)
        own = jax.random.fold_in(state.key, _STREAM)
        keys = jax.random.split(jax.random.fold_in(own, self._inside) if self._inside else own)
        late = {name: value for name, value in state.obs.items() if self.of is None or name in self.of}
        size, spec = _longest(self.observation) + 1, self.action_spec
        idle = jnp.clip(jnp.zeros((_longest(self.action), *spec.shape), state.reward.dtype), spec.low, spec.high)
        flight = InFlight(
            observations={name: jnp.broadcast_to(value, (size, *value.shape)) for name, value in late.items()},
            actions=idle,
            observation_delay=_drawn(self.observation, keys[0]),
            action_delay=_drawn(self.action, keys[1]),
            inner=state.delayed,
        )
        return state.replace(delayed=flight)

    def step(self, state: State, action: Array) -> State:
        action = checked_action(action, self.action_spec)
        check_began(self, isinstance(state.delayed, InFlight))
        flight: InFlight = state.delayed  # type: ignore[assignment]
        given = jnp.concatenate([_clipped(action, self.action_spec, flight.actions.dtype)[None], flight.actions])
        present = {name: history[0] for name, history in flight.observations.items()}
        inner = state.replace(obs={**state.obs, **present}, delayed=flight.inner)
        new = self.env.step(inner, _taken(given, self.action, flight.action_delay))
        seen = {
            name: jnp.concatenate([new.obs[name][None], history[:-1]]) for name, history in flight.observations.items()
        }
        late = {name: _taken(history, self.observation, flight.observation_delay) for name, history in seen.items()}
        return new.replace(
            obs={**new.obs, **late},
            delayed=flight.replace(observations=seen, actions=given[:-1], inner=new.delayed),
        )

    @property
    def _inside(self) -> int:
        """How many environments with latency this one is wrapped around: each draws delays of its own."""
        return count_inside(self, Latency)

    def __getattr__(self, name: str) -> Any:
        """All other attributes are those of the environment, also those that tasks have beyond the protocol."""
        return forwarded(self, name)


def _checked(name: str, steps: Any) -> Steps:
    """The delay, or the range of delays, as Python integers."""
    ends = (steps, steps) if np.ndim(steps) == 0 else tuple(steps)
    whole = all(isinstance(end, (int, np.integer)) and not isinstance(end, bool) for end in ends)
    if len(ends) != 2 or not whole or not 0 <= ends[0] <= ends[1]:
        raise ValueError(f"{name} of the latency is {steps!r}: give control steps, 2, or the ends of a range, (0, 2)")
    low, high = int(ends[0]), int(ends[1])
    return low if low == high else (low, high)


def _longest(steps: Steps) -> int:
    return steps if isinstance(steps, int) else steps[1]


def _drawn(steps: Steps, key: Key) -> Array:
    low, high = (steps, steps) if isinstance(steps, int) else steps
    return jax.random.randint(key, (), low, high + 1, jnp.int32)


def _clipped(action: Array, spec: ArraySpec, dtype: Any) -> Array:
    """The action within its bounds."""
    return clipped(jnp.asarray(action, dtype), spec.low, spec.high).astype(dtype)


def _taken(newest_first: Array, steps: Steps, delay: Array) -> Array:
    """The entry that is ``delay`` steps old."""
    return newest_first[steps] if isinstance(steps, int) else newest_first[delay]


__all__ = ["InFlight", "Latency", "Steps"]
