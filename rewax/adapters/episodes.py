"""Many environments in one compiled program, as learners with their own loop expect them: NumPy arrays and dicts."""

from typing import Any

import jax
import numpy as np

from rewax.adapters.conversion import (
    batch_observation,
    check_action,
    checked_num_envs,
    compiled,
    key_from,
    numpy_metrics,
)
from rewax.envs.base import Env, State
from rewax.envs.registry import require_env
from rewax.envs.wrappers import AutoReset, Vmap
from rewax.status import describe


class Episodes:
    """A batch of environments that begin a new episode in the step that ends one.

    ``infos`` has one dict for each environment, with the keys that Stable-Baselines3 reads: ``TimeLimit.truncated``
    at every step; at the end of an episode also ``terminal_observation``, ``episode`` (its return ``r`` and length
    ``l``), the task's metrics and the status in words.

    Args:
      env: an environment of rewax, unbatched, without ``AutoReset``.
      num_envs: number of environments.
      flat: observations are one vector for each environment, arrays in the order of their names.

    Raises:
      ValueError: ``env`` is no environment, resets by itself or is a batch, or ``num_envs`` is below 1.
    """

    def __init__(self, env: Env, num_envs: int, *, flat: bool = False) -> None:
        require_env(env)
        self.env, self.num_envs, self.flat = env, checked_num_envs(num_envs), flat
        self._reset, self._step = compiled(Vmap(env=AutoReset(env=env)))
        self._state: State | None = None

    def reset(self, generator: np.random.Generator) -> Any:
        """First observations: a dict of float32 arrays, or one array if ``flat``, with a leading axis."""
        self._state = state = self._reset(jax.random.split(key_from(generator), self.num_envs))
        self._returns, self._lengths = np.zeros(self.num_envs), np.zeros(self.num_envs, int)
        return batch_observation(state.obs, flat=self.flat)

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations, rewards (float32), whether an episode ended (bool), and infos, of one control step.

        Raises:
          ValueError: no episode has begun, or the actions have another shape or are not finite.
        """
        if self._state is None:
            raise ValueError("no episode has begun: call reset before step")
        actions = check_action(actions, (self.num_envs, *self.env.action_spec.shape))
        self._state = state = self._step(self._state, actions)
        rewards, done = np.array(state.reward, np.float32), np.array(state.done)
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": bool(t)} for t in np.asarray(state.truncated)]
        if done.any():
            self._describe_ends(state, np.flatnonzero(done), infos)
            self._returns[done], self._lengths[done] = 0.0, 0
        return batch_observation(state.obs, flat=self.flat), rewards, done, infos

    def _describe_ends(self, state: State, ended: np.ndarray, infos: list[dict[str, Any]]) -> None:
        assert state.final_obs is not None
        last = batch_observation(state.final_obs, flat=self.flat)
        metrics = numpy_metrics(state)
        status = metrics.pop("status")
        for i in ended:
            infos[i] |= {name: value[i].item() for name, value in metrics.items()}
            infos[i] |= {
                "terminal_observation": last[i] if self.flat else {name: a[i] for name, a in last.items()},
                "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i])},
                "status": describe(int(status[i])),
            }


__all__ = ["Episodes"]
