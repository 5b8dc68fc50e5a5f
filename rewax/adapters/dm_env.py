"""Environments for dm_env and the libraries that use it: Acme, for example.

    env = DmEnvironment(rewax.make("RollingFlat"), seed=0)

No gradient passes through.
"""

from typing import Any

import numpy as np

from rewax.adapters.conversion import check_action, check_one_episode, compiled, key_from, missing, numpy_observation
from rewax.envs.base import ArraySpec, Env, State

try:
    import dm_env
    from dm_env import specs
except ImportError as error:
    raise missing("dm_env", "dm-env") from error


class DmEnvironment(dm_env.Environment):
    """One environment. A terminated episode ends with discount 0, one at its time limit with discount 1.

    Args:
      env: an environment of rewax, unbatched, without ``AutoReset``.
      seed: seed of the first states of all episodes.

    Raises:
      ValueError: ``env`` is no environment, resets by itself or is a batch. ``step``: an action of another shape, or
        one that is not finite.
    """

    def __init__(self, env: Env, *, seed: int = 0) -> None:
        check_one_episode(env)
        self.env = env
        self._generator = np.random.default_rng(seed)
        self._reset, self._step = compiled(env)
        self._state: State | None = None

    def reset(self) -> dm_env.TimeStep:
        self._state = state = self._reset(key_from(self._generator))
        return dm_env.restart(numpy_observation(state))

    def step(self, action: Any) -> dm_env.TimeStep:
        """One control step. The first call, and the call after the end of an episode, begin a new episode instead."""
        if self._state is None or bool(self._state.done):
            return self.reset()
        self._state = state = self._step(self._state, check_action(action, self.env.action_spec.shape))
        reward, obs = float(state.reward), numpy_observation(state)
        if bool(state.terminated):
            return dm_env.termination(reward, obs)
        return dm_env.truncation(reward, obs) if bool(state.truncated) else dm_env.transition(reward, obs)

    def observation_spec(self) -> dict[str, specs.Array]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return {name: bounded(spec, name) for name, spec in self.env.observation_spec.items()}

    def action_spec(self) -> specs.BoundedArray:  # pyright: ignore[reportIncompatibleMethodOverride]
        return bounded(self.env.action_spec, "action")


def bounded(spec: ArraySpec, name: str) -> specs.BoundedArray:
    """A spec as a ``BoundedArray`` of float32."""
    return specs.BoundedArray(shape=spec.shape, dtype=np.float32, minimum=spec.low, maximum=spec.high, name=name)
