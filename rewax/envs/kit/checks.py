"""Mistakes in the arguments of an environment's methods, and in what a task's methods return, in one sentence."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.base import ArraySpec


def check_action(action: Any, spec: ArraySpec) -> None:
    """Whether an action has the shape of one environment's action.

    Raises:
      ValueError: otherwise.
    """
    if np.shape(action) != spec.shape:
        raise ValueError(
            f"the action has shape {np.shape(action)}: give shape {spec.shape}, and jax.vmap over step for a batch"
        )


def check_key(key: Any) -> None:
    """Whether a key is one random key of JAX, typed (``jax.random.key``) or raw (``jax.random.PRNGKey``).

    Raises:
      ValueError: otherwise.
    """
    typed = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    raw = isinstance(key, (jax.Array, np.ndarray)) and key.dtype == np.uint32 and key.ndim >= 1
    if not typed and not raw:
        raise ValueError(f"the key is {described(key)}: give a random key, jax.random.key(0) for example")
    shape = key.shape if typed else key.shape[:-1]
    if shape != ():
        raise ValueError(f"the key holds keys of shape {shape}: give one key, and jax.vmap over reset for a batch")


def checked_observation(task: Any, obs: Any) -> Any:
    """What ``observe`` of a task returned.

    Raises:
      ValueError: it is not named arrays.
    """
    if not isinstance(obs, Mapping) or not obs:
        raise ValueError(
            f"{type(task).__name__}.observe returned {described(obs)}: return a dict of arrays, "
            '{"state": ...} for example'
        )
    return obs


def checked_reward(task: Any, returned: Any) -> tuple[Any, Any]:
    """What ``reward`` of a task returned: the reward, shape (), and named scalars.

    Raises:
      ValueError: it is something else.
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
    """What ``start`` of a task returned: so many parts.

    Raises:
      ValueError: it is something else.
    """
    if not isinstance(returned, tuple) or len(returned) != len(parts):
        raise ValueError(
            f"{type(task).__name__}.start returned {described(returned)}: return {', '.join(parts[:-1])} and "
            f"{parts[-1]}, which may be None"
        )
    return returned


def checked_poses(task: Any, poses: Any, num: int) -> Any:
    """What ``poses`` of a task returned for so many moments.

    Raises:
      ValueError: there is no axis of bodies, or there are other moments.
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
    """A short value itself, an array by type and shape."""
    if isinstance(value, (jax.Array, np.ndarray)):
        return f"an array of {value.dtype} of shape {value.shape}"
    if isinstance(value, tuple) and type(value) is tuple:
        return f"a tuple of {len(value)}"
    return repr(value) if isinstance(value, (bool, int, float, str, type(None))) else f"a {type(value).__name__}"
