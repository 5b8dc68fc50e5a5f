"""Simulates an environment with given unknowns: particles at the times of a record's frames."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.randomized import Randomized
from rewax.envs.wrappers import _Wrapper
from rewax.identify.records import Record
from rewax.identify.unknowns import Space
from rewax.types import Array, Key, PyTree


class Data(NamedTuple):
    """The arrays of a record that a compiled fit takes; T frames of N points, A actions."""

    clouds: Array
    """[m], shape (T, N, 3); absent points are finite."""
    mask: Array
    """Shape (T, N), bool."""
    actions: Array
    """Shape (A, num_actions)."""
    before: Array
    """Control steps before each frame, int32, shape (T,)."""
    fraction: Array
    """Time since then in control steps, shape (T,)."""
    clusters: Array
    """Number of the region of each point, int32, shape (T, N), see ``regions``."""
    width: Array
    """Width of the surface's weights [m], shape ()."""
    key: Array
    """Key of the reset."""
    num_steps: Array | None = None
    """Control steps to simulate, int32, shape (); the body rests afterwards. None: all."""


def data_of(record: Record, width: float, num_regions: int, seed: int = 0) -> Data:
    steps = record.frame_steps
    before = np.clip(np.floor(steps + 1e-6), 0, len(record.actions) - 1).astype(np.int32)
    clouds = np.where(record.mask[..., None], record.clouds, 0.0).astype(np.float32)
    return Data(
        clouds=jnp.asarray(clouds), mask=jnp.asarray(record.mask), actions=jnp.asarray(record.actions, jnp.float32),
        before=jnp.asarray(before), fraction=jnp.asarray(np.clip(steps - before, 0.0, 1.0), jnp.float32),
        clusters=jnp.asarray(regions(record.clouds, record.mask, num_regions)), width=jnp.float32(width),
        key=jax.random.key(seed),
    )  # fmt: skip


def up_to(data: Data, horizon: float) -> Data:
    """The data with only the control steps before the frames within a share of the record's duration."""
    last = float(data.before[-1]) + float(data.fraction[-1])
    return data._replace(num_steps=jnp.int32(np.ceil(horizon * last - 1e-6)))


def regions(clouds: np.ndarray, mask: np.ndarray, num_regions: int) -> np.ndarray:
    """Regions of space with about equally many points: ``num_regions`` squared bins along the two longest axes.

    Errors of neighbouring points are alike, also from frame to frame: a region counts as one observation.

    Returns:
      int32, shape (T, N).
    """
    extent = np.ptp(np.quantile(clouds[mask], [0.02, 0.98], axis=0), axis=0)
    first, second = np.argsort(-extent)[:2]
    number = np.zeros(mask.shape, np.int32)
    for axis in (first, second):
        edges = np.quantile(clouds[mask][:, axis], np.arange(1, num_regions) / num_regions)
        number = number * num_regions + np.searchsorted(edges, clouds[..., axis]).astype(np.int32)
    return number


def simulated_frames(env: Any, space: Space, latent: Array, data: Data) -> tuple[Array, Array]:
    """Particles at the times of the frames [m], shape (T, num_particles, 3), and status bits, shape ().

    Args:
      env: one environment.
      space, latent: unknowns, shape (k,).
      data: actions and times.

    Gradient: exact, through the physics, in both modes; zero after a step that failed.
    """
    env = space.place(env, latent)
    state = env.reset(data.key)
    state = state.replace(physics=space.start(state.physics, latent))

    def step(state: Any, at: tuple[Array, Array]) -> tuple[Any, tuple[Array, Array]]:
        number, action = at
        if data.num_steps is None:
            state = env.step(state, action)
        else:
            state = jax.lax.cond(number < data.num_steps, env.step, lambda state, action: state, state, action)
        return state, (points_of(env, state.physics), state.status)

    first = points_of(env, state.physics)
    _, (rest, status) = jax.lax.scan(step, state, (jnp.arange(len(data.actions)), data.actions))
    every = jnp.concatenate([first[None], rest])
    fraction = data.fraction[:, None, None]
    frames = (1.0 - fraction) * every[data.before] + fraction * every[data.before + 1]
    return frames, jax.lax.reduce(status, np.int32(0), jax.lax.bitwise_or, (0,))


def points_of(env: Any, physics: PyTree) -> Array:
    """Points of an environment's soft bodies [m], shape (num_points, 3).

    Raises:
      ValueError: the environment has no ``particles``.
    """
    bare = getattr(env, "unwrapped", env)
    if not callable(getattr(bare, "particles", None)):
        raise ValueError(f"{type(bare).__name__} has no soft body for a record: choose a task on soft bodies")
    return bare.particles(physics)


def drawn_once(env: Any, key: Key) -> Any:
    """The environment with one draw of the parameters that it would draw at every reset."""
    if isinstance(env, Randomized):
        inside_key, key = jax.random.split(key)
        return env.randomize(key, drawn_once(env.env, inside_key))
    return dataclasses.replace(env, env=drawn_once(env.env, key)) if isinstance(env, _Wrapper) else env


def without_reset_noise(env: Any) -> Any:
    """The environment with its ``noise_fields`` 0, by default ``noise``, so that every episode begins alike.

    Goals may still be drawn: only the soft body, the tools and the robot are compared.

    Raises:
      ValueError: the environment has no soft body, draws parameters at every reset, or its episodes begin differently
        all the same.
    """
    still = _noise_left_out(env)
    starts = jax.jit(jax.vmap(lambda key: _beginning(still, still.reset(key).physics)))(
        jax.random.split(jax.random.key(0))
    )
    if not all(np.array_equal(a, b, equal_nan=True) for a, b in map(np.asarray, jax.tree.leaves(starts))):
        raise ValueError(
            f"episodes of {type(getattr(env, 'unwrapped', env)).__name__} begin differently without the noise of a "
            "reset, too: name the sizes of what its start draws in noise_fields, or draw nothing"
        )
    return still


def _noise_left_out(env: Any) -> Any:
    if isinstance(env, Randomized):
        raise ValueError(
            "the environment is Randomized: each reset would replace parameters by a draw. Give one draw of it, "
            "env.randomize(key, env.env)"
        )
    if isinstance(env, _Wrapper):
        return dataclasses.replace(env, env=_noise_left_out(env.env))
    names = [name for name in getattr(env, "noise_fields", ("noise",)) if getattr(env, name, None) is not None]
    if not names or not hasattr(env, "replace"):
        return env
    return env.replace(**{name: jax.tree.map(jnp.zeros_like, getattr(env, name)) for name in names})


def _beginning(env: Any, physics: PyTree) -> list[PyTree]:
    """What has to be the same at the beginning of a record and of its fit."""
    moving = ("soft", "rigid", "joint_q", "joint_qd")
    return [points_of(env, physics), *(getattr(physics, name, None) for name in moving)]


__all__ = ["Data", "data_of", "drawn_once", "points_of", "regions", "simulated_frames", "up_to", "without_reset_noise"]
