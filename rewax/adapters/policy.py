"""A trained policy for the environments of other libraries: NumPy arrays in, NumPy arrays out.

    act = numpy_policy(rewax.load_policy("HandFlip"))
    obs, reward, terminated, truncated, info = env.step(act(obs))

It needs no library beyond those of rewax. No gradient passes through; for tensors with gradients pass ``SavedRun.act``
to ``torch_function``.
"""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from rewax.envs.memory import action_of
from rewax.training.storage.saved import SavedRun


def numpy_policy(run: SavedRun, *, deterministic: bool = True, seed: int = 0) -> "NumpyActor":
    """The policy of a run as a function of one observation or of a batch of observations.

    Args:
      run: from ``load_policy`` or ``load_run``.
      deterministic: whether the action is the median of its distribution, see ``TanhNormal.mode``; else it is drawn.
      seed: seed of the draws.
    """
    return NumpyActor(run, deterministic=deterministic, seed=seed)


class NumpyActor:
    """``act(obs)``, as ``numpy_policy`` returns it.

    ``obs`` is a dict of arrays by name, as ``GymnasiumEnv``, ``GymnasiumVectorEnv`` and ``DmEnvironment`` return it.
    It needs the observations that the policy was told to ``observe``, by default all.
    The action has the leading axis of the observation. A policy with memory keeps it from call to call. It begins anew
    where ``done`` is True: where ``obs`` is the first observation of an episode; ``reset`` does so for all.

    Raises:
      ValueError: an array is missing or has another shape, or the memory is that of another number of environments.
    """

    def __init__(self, run: SavedRun, *, deterministic: bool = True, seed: int = 0) -> None:
        spec = run.env.observation_spec
        self._shapes = {name: tuple(spec[name].shape) for name in getattr(run.agent.config, "observe", ()) or spec}
        self._generator = np.random.default_rng(seed)
        self._initial = None if run.initial_memory is None else np.asarray(run.initial_memory)
        self._memory: np.ndarray | None = None

        def one(obs: Any, key: Any, memory: Any) -> Any:
            return run.act(obs, None if deterministic else key, memory=memory)

        self._single, self._batched = jax.jit(one), jax.jit(jax.vmap(one))

    def reset(self) -> None:
        """Forget everything: all episodes begin."""
        self._memory = None

    def __call__(self, obs: Mapping[str, Any], done: Any = None) -> np.ndarray:
        """The actions. ``done``: shape () or that of the batch, bool; None: no episode begins."""
        arrays = {name: np.asarray(obs[name], np.float32) for name in self._shapes if name in obs}
        found = {name: array.shape for name, array in arrays.items()}
        key = jax.random.key(int(self._generator.integers(2**31)))
        if found == self._shapes:
            return self._remembered(self._single(arrays, key, self._before((), done)))
        leading = {shape[:1] for shape in found.values()}
        if len(leading) != 1 or {name: shape[1:] for name, shape in found.items()} != self._shapes:
            raise ValueError(
                f"the observation has the arrays {found}: this policy needs {self._shapes}, or a batch of them"
            )
        (count,) = leading.pop()
        return self._remembered(self._batched(arrays, jax.random.split(key, count), self._before((count,), done)))

    def _before(self, batch: tuple[int, ...], done: Any) -> np.ndarray | None:
        """The memory before a step."""
        if self._initial is None:
            return None
        first = np.broadcast_to(self._initial, (*batch, *self._initial.shape))
        if self._memory is None or done is None:
            return first if self._memory is None else self._checked(batch)
        return np.where(np.asarray(done, bool)[..., None], first, self._checked(batch))

    def _checked(self, batch: tuple[int, ...]) -> np.ndarray:
        """The memory of the step before, for a batch of the same shape."""
        assert self._memory is not None
        if self._memory.shape[:-1] != batch:
            raise ValueError(
                f"the observation has the batch {batch}, but the memory that of {self._memory.shape[:-1]}: call "
                "reset() where other episodes begin"
            )
        return self._memory

    def _remembered(self, moved: Any) -> np.ndarray:
        if self._initial is not None:
            self._memory = np.asarray(moved.memory)
        return np.asarray(action_of(moved))


__all__ = ["NumpyActor", "numpy_policy"]
