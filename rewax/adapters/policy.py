"""A trained policy for the environments of other libraries: NumPy arrays in, NumPy arrays out.

    act = numpy_policy(rewax.load_policy("HandFlip"))
    obs, reward, terminated, truncated, info = env.step(act(obs))

It needs no library beyond those of rewax. No gradient passes through; for tensors with gradients pass ``SavedRun.act``
to ``torch_function``.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from rewax.training.storage.saved import SavedRun


def numpy_policy(
    run: SavedRun, *, deterministic: bool = True, seed: int = 0
) -> Callable[[Mapping[str, Any]], np.ndarray]:
    """The policy of a run as a function of one observation or of a batch of observations.

    Args:
      run: from ``load_policy`` or ``load_run``.
      deterministic: whether the action is the most likely one; else it is drawn.
      seed: seed of the draws.

    Returns:
      ``act(obs)``. ``obs`` is a dict of arrays by name, as ``GymnasiumEnv``, ``GymnasiumVectorEnv`` and
      ``DmEnvironment`` return it. The action has the leading axis of the observation. ``act`` raises ValueError if an
      array is missing or has another shape.
    """
    shapes = {name: tuple(spec.shape) for name, spec in run.env.observation_spec.items()}
    generator = np.random.default_rng(seed)

    def one(obs: Any, key: Any) -> Any:
        return run.act(obs, None if deterministic else key)

    single, batched = jax.jit(one), jax.jit(jax.vmap(one))

    def act(obs: Mapping[str, Any]) -> np.ndarray:
        arrays = {name: np.asarray(obs[name], np.float32) for name in shapes if name in obs}
        found = {name: array.shape for name, array in arrays.items()}
        key = jax.random.key(int(generator.integers(2**31)))
        if found == shapes:
            return np.asarray(single(arrays, key))
        leading = {shape[:1] for shape in found.values()}
        if len(leading) != 1 or {name: shape[1:] for name, shape in found.items()} != shapes:
            raise ValueError(f"the observation has the arrays {found}: this policy needs {shapes}, or a batch of them")
        return np.asarray(batched(arrays, jax.random.split(key, leading.pop()[0])))

    return act


__all__ = ["numpy_policy"]
