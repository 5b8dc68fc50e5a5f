"""Environments for gymnasium and all that builds on it, one or many at once.

    env = GymnasiumEnv(rewax.make("RollingFlat"))
    envs = GymnasiumVectorEnv(rewax.make("RollingFlat"), num_envs=16)

Observations are ``Dict`` spaces of float32, point clouds with shape (num_points, 3): ``gymnasium.wrappers`` flattens
them for those who want one vector. No gradient passes through.
"""

from typing import Any, ClassVar

import jax
import numpy as np

from rewax.adapters.conversion import (
    check_action,
    compiled,
    key_from,
    missing,
    numpy_metrics,
    numpy_observation,
    state_info,
)
from rewax.envs.base import ArraySpec, Env, State
from rewax.envs.wrappers import AutoReset, Vmap

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise missing("gymnasium", "gymnasium") from error


class GymnasiumEnv(gymnasium.Env):
    """One environment; it needs ``reset`` after the end of an episode.

    ``info`` holds the task's metrics, and ``status``: "OK", or the names of what failed.

    Args:
      env: an environment of rewax, unbatched, without ``AutoReset``.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(self, env: Env) -> None:
        self.env = env
        self.observation_space = observation_space(env)
        self.action_space = box(env.action_spec)
        self._reset, self._step = compiled(env)
        self._state: State | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._state = state = self._reset(key_from(self.np_random))
        return numpy_observation(state), state_info(state)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset before step")
        self._state = state = self._step(self._state, check_action(action, self.env.action_spec.shape))
        ends = bool(state.terminated), bool(state.truncated)
        return numpy_observation(state), float(state.reward), *ends, state_info(state)


class GymnasiumVectorEnv(VectorEnv):
    """Many environments in one compiled program; each begins anew in the step that ends its episode.

    In that step ``infos["final_obs"]`` and ``infos["final_info"]`` hold the end of the old episode, as in gymnasium's
    mode ``SAME_STEP``. All other entries of ``infos`` are arrays over the environments; ``status`` holds bits of
    ``rewax.Status``.

    Args:
      env: an environment of rewax, unbatched, without ``AutoReset``.
      num_envs: how many.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, env: Env, num_envs: int) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}: give 1 or more")
        self.env, self.num_envs = env, num_envs
        self.single_observation_space = observation_space(env)
        self.single_action_space = box(env.action_spec)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._reset, self._step = compiled(Vmap(env=AutoReset(env=env)))
        self._state: State | None = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """seed: one number, or one per environment."""
        if seed is None or isinstance(seed, (int, np.integer)):
            super().reset(seed=None if seed is None else int(seed))
            keys = jax.random.split(key_from(self.np_random), self.num_envs)
        else:
            if len(seed) != self.num_envs:
                raise ValueError(f"there are {len(seed)} seeds for {self.num_envs} environments: give one for each")
            keys = jax.numpy.stack([key_from(np.random.default_rng(s)) for s in seed])
        self._state = state = self._reset(keys)
        return numpy_observation(state), self._infos(numpy_metrics(state))

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset before step")
        shape = (self.num_envs, *self.env.action_spec.shape)
        self._state = state = self._step(self._state, check_action(actions, shape))
        infos = self._infos(numpy_metrics(state))
        done = np.asarray(state.done)
        if done.any():
            last = {name: np.asarray(value) for name, value in state.final_obs.items()}
            final = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(done):
                final[i] = {name: value[i] for name, value in last.items()}
            metrics = numpy_metrics(state)
            ended = {**metrics, **{f"_{name}": done for name in metrics}}
            infos |= {"final_obs": final, "_final_obs": done, "final_info": ended, "_final_info": done}
        rewards = np.asarray(state.reward, np.float64)
        return numpy_observation(state), rewards, np.array(state.terminated), np.array(state.truncated), infos

    def _infos(self, metrics: dict[str, np.ndarray]) -> dict[str, Any]:
        return {**metrics, **{f"_{name}": np.ones(self.num_envs, bool) for name in metrics}}


def observation_space(env: Env) -> spaces.Dict:
    """The observation's arrays, each a ``Box`` of float32."""
    return spaces.Dict({name: box(spec) for name, spec in env.observation_spec.items()})


def box(spec: ArraySpec) -> spaces.Box:
    """The arrays of a spec, float32."""
    return spaces.Box(low=spec.low, high=spec.high, shape=spec.shape, dtype=np.float32)
