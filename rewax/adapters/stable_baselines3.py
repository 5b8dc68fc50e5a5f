"""Environments for Stable-Baselines3, many in one compiled program.

    envs = StableBaselinesVecEnv(rewax.make("RollingFlat"), num_envs=64, seed=0)
    stable_baselines3.PPO("MultiInputPolicy", envs).learn(total_timesteps=100_000)

No gradient passes through.
"""

from typing import Any

import numpy as np

from rewax.adapters.conversion import missing
from rewax.adapters.episodes import Episodes
from rewax.envs.base import Env

try:
    from gymnasium import spaces
    from stable_baselines3.common.monitor import Monitor  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise missing("stable_baselines3", "stable-baselines3") from error


class StableBaselinesVecEnv(VecEnv):
    """A ``VecEnv``: each environment begins a new episode in the step that ends one.

    ``infos`` is that of ``rewax.adapters.episodes.Episodes``: ``terminal_observation``, ``TimeLimit.truncated`` and
    the return of each episode that ended, which Stable-Baselines3 logs without a ``VecMonitor``.

    Args:
      env: an environment of rewax, unbatched, without ``AutoReset``.
      num_envs: number of environments.
      seed: of the first states of all episodes; ``seed(...)`` sets another one for the next ``reset``.
      flat: observations are one vector, for ``"MlpPolicy"``; else a dict, for ``"MultiInputPolicy"``.

    Raises:
      ValueError: ``env`` is no environment, resets by itself or is a batch, or ``num_envs`` is below 1. A step: no
        episode has begun, or actions of another shape, or not finite.
    """

    def __init__(self, env: Env, num_envs: int, *, seed: int = 0, flat: bool = False) -> None:
        from rewax.adapters.gymnasium_env import box, observation_space

        self.env, self._episodes = env, Episodes(env, num_envs, flat=flat)
        self._generator = np.random.default_rng(seed)
        space: Any = observation_space(env)
        if flat:
            space = spaces.Box(-np.inf, np.inf, (spaces.flatdim(space),), np.float32)
        super().__init__(self._episodes.num_envs, space, box(env.action_spec))

    def reset(self) -> Any:
        if self._seeds[0] is not None:
            self._generator = np.random.default_rng(self._seeds[0])
            self._reset_seeds()
        return self._episodes.reset(self._generator)

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        return self._episodes.step(self._actions)

    def close(self) -> None:
        """Nothing is held open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the environment, which all of the batch share."""
        value = None if attr_name == "render_mode" else getattr(self.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(f"environments of rewax are immutable: make another one with {attr_name} changed")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return [getattr(self.env, method_name)(*args, **kwargs) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """False, except for ``Monitor``, because ``infos`` has the returns and lengths that it adds."""
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]


__all__ = ["StableBaselinesVecEnv"]
