"""What the cameras of an environment show, for recordings."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.base import State
from rewax.envs.randomized import Randomized
from rewax.envs.sensing import Sensing
from rewax.envs.wrappers import AutoReset, Vmap
from rewax.sensors.camera import Camera
from rewax.types import Array
from rewax.viz.seen import NOTHING, Seen, stride

Pixels = dict[str, Array]


def as_recorded(env: Any) -> Any:
    """One environment with its own parameters, and with all that changes observations and actions.

    It leaves out ``AutoReset`` around it, and ``Randomized`` everywhere: an episode is shown as it is without draws. Of
    a batch it is the first environment.
    """
    while isinstance(env, (Randomized, AutoReset, Vmap)):
        env = env._first if isinstance(env, Vmap) else env.env
    return _without_draws(env)


def _without_draws(env: Any) -> Any:
    """The environment without ``Randomized`` inside its wrappers."""
    if isinstance(env, Randomized):
        return _without_draws(env.env)
    inside = _inside(env)
    bare = _without_draws(inside) if inside is not None else None
    return env if bare is inside else env.replace(env=bare)


def has_cameras(env: Any) -> bool:
    """Whether an environment has sensors that show pictures."""
    return any(isinstance(each, Sensing) and _cameras(each) for each in _chain(env))


def make_pixels(env: Any) -> Callable[[State], Pixels]:
    """A compiled function from a state to the bytes of each picture, ``{title: (height, width)}``; see ``Seen``."""
    if not has_cameras(env):
        return lambda state: {}

    def pixels(state: State) -> Pixels:
        found: Pixels = {}
        for sensing in _sensings(env, state):
            world = sensing.world_of(state)
            for name, camera in _cameras(sensing).items():
                view, every = camera.view(world), stride(camera.height, camera.width)
                observed = state.obs[name] if isinstance(sensing.sensors[name], Camera) else None
                depth = (
                    (view.depth - camera.near) / (camera.far - camera.near) if observed is None else observed[..., 0]
                )
                in_range = jnp.round((NOTHING - 1) * jnp.clip(depth, 0.0, 1.0))
                found[f"{name} depth"] = jnp.where(depth < 1.0, in_range, NOTHING)[::every, ::every]
                found[f"{name} bodies"] = jnp.where(view.label >= 0, view.label, NOTHING)[::every, ::every]
        return {title: values.astype(jnp.uint8) for title, values in found.items()}

    return jax.jit(pixels)


def seen_by(env: Any, physics: Any, frames: list[dict[str, Any]]) -> list[Seen]:
    """The pictures of a recording.

    Args:
      env: the environment.
      physics: of one state, for the names of bodies.
      frames: what ``make_pixels`` gave for each frame.
    """
    found = []
    for sensing in (each for each in _chain(env) if isinstance(each, Sensing)):
        names = jax.eval_shape(sensing.world, physics).names
        for name, camera in _cameras(sensing).items():
            depth, bodies = (
                np.stack([np.asarray(f[f"{name} {kind}"]) for f in frames]) for kind in ("depth", "bodies")
            )
            found.append(Seen(name=name, kind="depth", pixels=depth, near=float(camera.near), far=float(camera.far)))
            found.append(Seen(name=name, kind="bodies", pixels=bodies, names=names))
    return found


def _chain(env: Any) -> list[Any]:
    """The environment and all that it is wrapped around, from the outside to the inside."""
    found = [env]
    while (env := _inside(env)) is not None:
        found.append(env)
    return found


def _inside(env: Any) -> Any:
    """What a wrapper is wrapped around; None for others."""
    return getattr(env, "__dict__", {}).get("env")


def _sensings(env: Any, state: State) -> list[Sensing]:
    """The environments with sensors in a chain of wrappers, with the parameters of the state's episode."""
    found = []
    while env is not None:
        if isinstance(env, Randomized):
            env = env.with_draws(state.drawn or {})
            continue
        if isinstance(env, Sensing):
            found.append(env)
        env = _inside(env)
    return found


def _cameras(sensing: Sensing) -> dict[str, Camera]:
    """The cameras among the sensors, and those of clouds, by the name of the observation."""
    cameras = {name: s if isinstance(s, Camera) else getattr(s, "camera", None) for name, s in sensing.sensors.items()}
    return {name: camera for name, camera in cameras.items() if isinstance(camera, Camera)}


__all__ = ["as_recorded", "has_cameras", "make_pixels", "seen_by"]
