"""History: a policy without memory sees the last observations side by side."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.base import ArraySpec, State
from rewax.envs.wrappers import _Wrapper, check_began, check_inside, forwarded, observed_names
from rewax.types import Array, Key, Observation


@struct.dataclass
class History(struct.Replaceable, _Wrapper):
    """An environment whose observations are the last ``steps`` ones, the newest first.

    They lie side by side along the last axis: a vector of 5 becomes one of 5 ``steps``, a picture gets ``steps`` times
    as many channels, and so does each point of a cloud. After a reset all of them are the first observation.

    Attributes:
      env: an environment; put ``History`` around ``Sensing`` and ``Latency``.
      steps: number of observations (static).
      of: names of the observations; None: all. Leave out observations of critics alone, and a ``DepthCloud``, because
        it has other points at each step (static).

    Example:
      >>> env = History(env=make("CartpoleSwingUp"), steps=4)

    Gradient: exact, through each observation to the step that it shows. None flows from a new episode to the old one.

    Raises:
      ValueError: ``steps`` is below 1, ``of`` has an unknown name, or the wrapper is around ``AutoReset`` or a batch.
        ``step``: the state is that of ``env`` alone.
    """

    steps: int = struct.static_field(default=4)
    of: tuple[str, ...] | None = struct.static_field(default=None)

    def __post_init__(self) -> None:
        check_inside(self)
        whole = isinstance(self.steps, (int, np.integer)) and not isinstance(self.steps, bool)
        if not whole or self.steps < 1:
            raise ValueError(f"steps of the history is {self.steps!r}: give a number of observations, at least 1")
        object.__setattr__(self, "steps", int(self.steps))
        object.__setattr__(self, "of", observed_names(self.env, self.of))

    @property
    def observation_spec(self) -> dict[str, ArraySpec]:
        return self._longer(self.env.observation_spec)

    def reset(self, key: Key) -> State:
        state = self.env.reset(key)
        return state.replace(obs=self._stacked(state.obs, [state.obs] * (self.steps - 1)))

    def step(self, state: State, action: Array) -> State:
        spec = self.env.observation_spec
        longer = self._longer(spec)
        held = {name: value for name, value in state.obs.items() if self._holds(name)}
        check_began(self, all(np.shape(value) == longer[name].shape for name, value in held.items()))
        past = [self._past(state.obs, spec, i) for i in range(self.steps)]
        new = self.env.step(state.replace(obs=past[0]), action)
        return new.replace(obs=self._stacked(new.obs, past[:-1]))

    def __getattr__(self, name: str) -> Any:
        """Everything else is the environment's own: pictures, rewards, what tasks offer beyond the protocol."""
        return forwarded(self, name)

    def _holds(self, name: str) -> bool:
        return self.of is None or name in self.of

    def _longer(self, specs: dict[str, ArraySpec]) -> dict[str, ArraySpec]:
        """The specifications of the observations side by side."""

        def longer(spec: ArraySpec) -> ArraySpec:
            *leading, last = spec.shape or (1,)
            return ArraySpec((*leading, last * self.steps), spec.low, spec.high)

        return {name: longer(one) if self._holds(name) else one for name, one in specs.items()}

    def _stacked(self, newest: Observation, past: list[Observation]) -> Observation:
        def one(name: str, value: Array) -> Array:
            if not self._holds(name):
                return value
            return jnp.concatenate([jnp.atleast_1d(each[name]) for each in (newest, *past)], axis=-1)

        return {name: one(name, value) for name, value in newest.items()}

    def _past(self, obs: Observation, spec: dict[str, ArraySpec], age: int) -> Observation:
        """The observation of ``age`` steps ago."""

        def one(name: str, value: Array) -> Array:
            if not self._holds(name):
                return value
            shape = spec[name].shape
            width = shape[-1] if shape else 1
            return value[..., age * width : (age + 1) * width].reshape(shape)

        return {name: one(name, value) for name, value in obs.items()}


__all__ = ["History"]
