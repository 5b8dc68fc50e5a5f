"""Functions that the adapters share: states to NumPy arrays, checks of actions."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from rewax.envs.base import Env, State
from rewax.envs.registry import require_env
from rewax.envs.wrappers import AutoReset, Vmap, is_or_contains
from rewax.status import describe


def missing(library: str, extra: str) -> ImportError:
    """The error of an adapter whose library is not installed."""
    return ImportError(f"{library} is not installed: pip install 'rewax[{extra}]'")


def numpy_observation(state: State) -> dict[str, np.ndarray]:
    """The observation as new NumPy arrays of float32, with a leading axis if the state has one."""
    return {name: np.array(value, np.float32) for name, value in state.obs.items()}


def numpy_metrics(state: State) -> dict[str, np.ndarray]:
    """The metrics of the task and the status bits, as NumPy arrays."""
    return {**{name: np.asarray(value) for name, value in state.metrics.items()}, "status": np.asarray(state.status)}


def state_info(state: State) -> dict[str, Any]:
    """The ``info`` of gymnasium: metrics as numbers, status in words."""
    numbers = {name: value.item() for name, value in numpy_metrics(state).items() if value.ndim == 0}
    return {**numbers, "status": describe(int(state.status))}


def batch_observation(obs: Mapping[str, Any], *, flat: bool) -> Any:
    """Observations with a leading axis as new arrays of float32 by name, or as one array in the order of the names."""
    arrays = {name: np.array(value, np.float32) for name, value in obs.items()}
    if not flat:
        return arrays
    return np.concatenate([arrays[name].reshape(len(arrays[name]), -1) for name in sorted(arrays)], axis=1)


def key_from(generator: np.random.Generator) -> jax.Array:
    """A JAX key drawn from a NumPy generator."""
    return jax.random.key(int(generator.integers(2**31)))


def check_action(action: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An action as a float32 array.

    Raises:
      ValueError: it has another shape, or holds a number that is not finite.
    """
    array = np.asarray(action, np.float32)
    if array.shape != shape:
        raise ValueError(f"the action has shape {array.shape}: give one of shape {shape}")
    if not np.isfinite(array).all():
        raise ValueError("the action holds a number that is not finite: check the policy that made it")
    return array


def checked_num_envs(num_envs: Any) -> int:
    """A number of environments.

    Raises:
      ValueError: it is no integer, or below 1.
    """
    if isinstance(num_envs, bool) or not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
        raise ValueError(f"num_envs is {num_envs!r}: give an integer of at least 1")
    return int(num_envs)


def check_one_episode(env: Any) -> None:
    """Raises ValueError unless a value is one environment: for batches too, and for what begins anew by itself."""
    require_env(env)
    for kind, remedy in ((AutoReset, "give it without: reset begins an episode"), (Vmap, "give one environment")):
        if is_or_contains(env, kind):
            raise ValueError(f"the environment has {kind.__name__}: {remedy}")


def compiled(env: Env) -> tuple[Any, Any]:
    """``reset`` and ``step``, each compiled when it is first called."""
    return jax.jit(env.reset), jax.jit(env.step)
