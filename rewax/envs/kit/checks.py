"""Checks of the arguments of an environment's methods and of the values that a task's methods return."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.base import ArraySpec
from rewax.physics.numerics.arguments import real_array
from rewax.physics.numerics.checks import described
from rewax.physics.numerics.pose import Pose
from rewax.types import Array, PyTree


def as_numbers(name: str, value: Any, remedy: str) -> Array:
    """The value as an array of real numbers or booleans.

    Raises:
      ValueError: it is none. The message has the name, the value and the remedy.
    """
    if isinstance(value, bool) or getattr(value, "dtype", None) == np.dtype(bool):
        return jnp.asarray(value)
    return jnp.asarray(real_array(name, value, remedy))


def checked_action(action: Any, spec: ArraySpec) -> Array:
    """The action of one environment as an array.

    Raises:
      ValueError: it holds something else than real numbers, or has another shape than ``spec``.
    """
    action = as_numbers("the action", action, f"give an array of shape {spec.shape}")
    if action.shape != spec.shape:
        raise ValueError(
            f"the action has shape {action.shape}: give shape {spec.shape}, and jax.vmap over step for a batch"
        )
    return action


def check_key(key: Any) -> None:
    """Raises ValueError unless a key is one random key, typed (``jax.random.key``) or raw (``jax.random.PRNGKey``)."""
    shape = _shape_of_keys(key, "give a random key, jax.random.key(0) for example")
    if shape != ():
        raise ValueError(f"the key holds keys of shape {shape}: give one key, and jax.vmap over reset for a batch")


def check_keys(keys: Any) -> None:
    """Raises ValueError unless the keys are an array of random keys."""
    remedy = "give one for each environment, jax.random.split(jax.random.key(0), num_envs)"
    if _shape_of_keys(keys, remedy) == ():
        raise ValueError(f"the key is a single one: {remedy}")


def _shape_of_keys(key: Any, remedy: str) -> tuple[int, ...]:
    typed = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    raw = isinstance(key, (jax.Array, np.ndarray)) and key.dtype == np.uint32 and key.ndim >= 1
    if not typed and not raw:
        raise ValueError(f"the key is {described(key)}: {remedy}")
    return key.shape if typed else key.shape[:-1]


def checked_observation(task: Any, obs: Any) -> dict[str, Array]:
    """The value that ``observe`` of a task returned, as a dict of arrays.

    Raises:
      ValueError: it is no dict, or an empty one, or its names or values are no text and no real numbers.
    """
    name = f"{type(task).__name__}.observe"
    if not isinstance(obs, Mapping) or not obs:
        raise ValueError(f'{name} returned {described(obs)}: return a dict of arrays, {{"state": ...}} for example')
    remedy = 'return real numbers by name, {"state": jnp.stack([...])} for example'
    return _named_numbers(f"{name}(physics)", obs, remedy)


def checked_reward(task: Any, returned: Any) -> tuple[Array, dict[str, Array]]:
    """The value that ``reward`` of a task returned, as arrays.

    Raises:
      ValueError: it is not a pair of a scalar and a dict of scalars.
    """
    name = f"{type(task).__name__}.reward"
    remedy = "return the reward and a dict of scalars to log, (reward, {}) for example"
    if not isinstance(returned, tuple) or len(returned) != 2 or not isinstance(returned[1], Mapping):
        raise ValueError(f"{name} returned {described(returned)}: {remedy}")
    reward = as_numbers(f"{name}(physics)[0]", returned[0], remedy)
    metrics = _named_numbers(f"{name}(physics)[1]", returned[1], remedy)
    shapes = {"the reward": reward.shape, **{repr(key): value.shape for key, value in metrics.items()}}
    if odd := [key for key, shape in shapes.items() if shape != ()]:
        raise ValueError(f"{name} returned {odd[0]} of shape {shapes[odd[0]]}: return scalars, of shape ()")
    return reward, metrics


def _named_numbers(whole: str, values: Mapping[Any, Any], remedy: str) -> dict[str, Array]:
    if odd := [key for key in values if not isinstance(key, str)]:
        raise ValueError(f"{whole} has the name {odd[0]!r}: use text for names")
    return {key: as_numbers(f"{whole}[{key!r}]", value, remedy) for key, value in values.items()}


def checked_terminated(task: Any, terminated: Any) -> Any:
    """The value that ``terminated`` of a task returned.

    Raises:
      ValueError: it is not one boolean.
    """
    boolean = isinstance(terminated, bool) or getattr(terminated, "dtype", None) == np.dtype(bool)
    if not boolean or np.shape(terminated) != ():
        raise ValueError(
            f"{type(task).__name__}.terminated returned {described(terminated)}: return one boolean, "
            "physics.rigid.qpos[0] > 1.0 for example"
        )
    return terminated


def checked_control(task: Any, control: Any) -> Any:
    """The value that ``control`` of a task returned.

    Raises:
      ValueError: it is None, which the physics would take for no control.
    """
    if control is None:
        raise ValueError(f"{type(task).__name__}.control returned None: return one number for each actuator")
    return control


def checked_start(task: Any, returned: Any, parts: Mapping[str, type]) -> Any:
    """The value that ``start`` of a task returned.

    Args:
      task: whose method it is.
      returned: the value.
      parts: class of each entry by its name in messages; after them comes the state of the task.

    Raises:
      ValueError: it is not a tuple of these parts and the state of the task, or that holds something else than arrays.
    """
    name = f"{type(task).__name__}.start"
    whole = f"return {', '.join(parts)} and the state of the task, which may be None"
    if not isinstance(returned, tuple) or len(returned) != len(parts) + 1:
        raise ValueError(f"{name} returned {described(returned)}: {whole}")
    for (part, kind), value in zip(parts.items(), returned, strict=False):
        if not isinstance(value, kind):
            raise ValueError(f"{name} returned {described(value)} for {part}, which must be a {kind.__name__}: {whole}")
    if odd := [leaf for leaf in jax.tree.leaves(returned[-1]) if not _is_numeric(leaf)]:
        raise ValueError(f"{name} returned {described(odd[0])} in the state of the task: keep arrays there, or None")
    return returned


def checked_next_task(task: Any, new: PyTree, old: PyTree) -> PyTree:
    """The value that ``next_task`` of a task returned.

    Raises:
      ValueError: it has other arrays than the state of the task before, or arrays of other shapes.
    """
    before, after = jax.tree.leaves(old), jax.tree.leaves(new)
    if jax.tree.structure(new) != jax.tree.structure(old) or not all(map(_is_numeric, after)):
        raise ValueError(
            f"{type(task).__name__}.next_task returned {described(new)} after {described(old)}: return the arrays that "
            "start returned, with new values"
        )
    for a, b in zip(after, before, strict=True):
        if np.shape(a) != np.shape(b):
            raise ValueError(
                f"{type(task).__name__}.next_task returned shape {np.shape(a)} after {np.shape(b)}: keep the shape"
            )
    return new


def _is_numeric(leaf: Any) -> bool:
    return isinstance(leaf, (jax.Array, np.ndarray, np.generic, bool, int, float))


def checked_poses(task: Any, poses: Any, num: int) -> Any:
    """The value that ``poses`` of a task returned for ``num`` moments.

    Raises:
      ValueError: it is no ``Pose``, there is no axis of bodies, or the number of moments is not ``num``.
    """
    name = f"{type(task).__name__}.poses"
    wanted = f"shapes ({num}, num_bodies, 3) and ({num}, num_bodies, 3, 3), also for one body"
    if not isinstance(poses, Pose):
        raise ValueError(f"{name} returned {described(poses)}: return a Pose of {wanted}")
    position, rotation = np.shape(poses.position), np.shape(poses.rotation)
    bodies = position[1] if len(position) == 3 else 1
    if (position, rotation) != ((num, bodies, 3), (num, bodies, 3, 3)):
        raise ValueError(
            f"{name} returned positions of shape {position} and rotations of shape {rotation} for {num} moments: "
            f"return {wanted}"
        )
    return poses
