"""Checks of the arguments of an environment's methods and of the values that a task's methods return."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.base import ArraySpec


def check_action(action: Any, spec: ArraySpec) -> None:
    """Raises ValueError unless an action has the shape of the action of one environment."""
    if np.shape(action) != spec.shape:
        raise ValueError(
            f"the action has shape {np.shape(action)}: give shape {spec.shape}, and jax.vmap over step for a batch"
        )


def check_key(key: Any) -> None:
    """Raises ValueError unless a key is one random key, typed (``jax.random.key``) or raw (``jax.random.PRNGKey``)."""
    typed = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    raw = isinstance(key, (jax.Array, np.ndarray)) and key.dtype == np.uint32 and key.ndim >= 1
    if not typed and not raw:
        raise ValueError(f"the key is {described(key)}: give a random key, jax.random.key(0) for example")
    shape = key.shape if typed else key.shape[:-1]
    if shape != ():
        raise ValueError(f"the key holds keys of shape {shape}: give one key, and jax.vmap over reset for a batch")


def checked_observation(task: Any, obs: Any) -> Any:
    """The value that ``observe`` of a task returned.

    Raises:
      ValueError: it is no dict, or an empty one.
    """
    if not isinstance(obs, Mapping) or not obs:
        raise ValueError(
            f"{type(task).__name__}.observe returned {described(obs)}: return a dict of arrays, "
            '{"state": ...} for example'
        )
    return obs


def checked_reward(task: Any, returned: Any) -> tuple[Any, Any]:
    """The value that ``reward`` of a task returned.

    Raises:
      ValueError: it is not a pair of a scalar and a dict of scalars.
    """
    name = f"{type(task).__name__}.reward"
    if not isinstance(returned, tuple) or len(returned) != 2 or not isinstance(returned[1], Mapping):
        raise ValueError(
            f"{name} returned {described(returned)}: return the reward and a dict of scalars to log, "
            "(reward, {}) for example"
        )
    shapes = {"the reward": jnp.shape(returned[0]), **{repr(key): jnp.shape(v) for key, v in returned[1].items()}}
    if odd := [key for key, shape in shapes.items() if shape != ()]:
        raise ValueError(f"{name} returned {odd[0]} of shape {shapes[odd[0]]}: return scalars, of shape ()")
    return returned


def checked_start(task: Any, returned: Any, parts: tuple[str, ...]) -> Any:
    """The value that ``start`` of a task returned.

    Raises:
      ValueError: it is not a tuple with as many entries as ``parts``.
    """
    if not isinstance(returned, tuple) or len(returned) != len(parts):
        raise ValueError(
            f"{type(task).__name__}.start returned {described(returned)}: return {', '.join(parts[:-1])} and "
            f"{parts[-1]}, which may be None"
        )
    return returned


def checked_poses(task: Any, poses: Any, num: int) -> Any:
    """The value that ``poses`` of a task returned for ``num`` moments.

    Raises:
      ValueError: there is no axis of bodies, or the number of moments is not ``num``.
    """
    position, rotation = np.shape(poses.position), np.shape(poses.rotation)
    bodies = position[1] if len(position) == 3 else 1
    if (position, rotation) != ((num, bodies, 3), (num, bodies, 3, 3)):
        raise ValueError(
            f"{type(task).__name__}.poses returned positions of shape {position} and rotations of shape {rotation} "
            f"for {num} moments: return shapes ({num}, num_bodies, 3) and ({num}, num_bodies, 3, 3), also for one body"
        )
    return poses


def described(value: Any) -> str:
    """A value in a message: numbers and strings themselves, arrays by type and shape, other objects by type."""
    if isinstance(value, (jax.Array, np.ndarray)):
        return f"an array of {value.dtype} of shape {value.shape}"
    if isinstance(value, tuple) and type(value) is tuple:
        return f"a tuple of {len(value)}"
    return repr(value) if isinstance(value, (bool, int, float, str, type(None))) else f"a {type(value).__name__}"
