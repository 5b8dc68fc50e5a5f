"""Records made from an environment: a script or a policy moves the tool, a camera with noise and occlusion looks on."""

import functools
import json
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.registry import recipe
from rewax.identify.records import Record, camera_numbers, cloud_of_depth
from rewax.identify.simulate import drawn_once, points_of, without_reset_noise
from rewax.physics.numerics.checks import NOT_NEGATIVE, check_number
from rewax.physics.rigid import RigidModel, body_name
from rewax.sensors import Camera, DepthNoise
from rewax.status import FATAL, describe
from rewax.types import Array, Key

Script = np.ndarray | Array | Callable[[Any, Key], Array]
"""Actions of shape (num_steps, num_actions), or a policy ``(state, key) -> action``."""


def record(
    env: Any,
    script: Script,
    key: Key,
    *,
    num_steps: int | None = None,
    every: int = 1,
    camera: Camera | None = None,
    num_points: int = 256,
    noise: float = 0.0,
    occlusion: float = 0.0,
    source: str = "",
) -> Record:
    """A record of one episode.

    Args:
      env: one environment with ``particles`` and ``world``; its reset noise is left out. One that draws its
        parameters (``Randomized``) draws them once.
      script: actions of shape (num_steps, num_actions), or a policy ``(state, key) -> action``.
      key: of the reset, the policy, noise and occlusion.
      num_steps: with a policy: control steps; by default an episode.
      every: control steps between two frames.
      camera: that looks on; None: one from above the body at the side, see ``camera_for``.
      num_points: largest size of a cloud.
      noise: standard deviation of depth [m].
      occlusion: share of the seen body that is hidden in all frames: the part on one side of a plane through it, which
        looks in a random direction. In [0, 1).
      source: where the record comes from; by default how the environment was made.

    Raises:
      ValueError: an option is illegal, or a step failed: the status is named.
    """
    _check_options(occlusion, noise, every)
    source = source or json.dumps(recipe(env))
    reset_key, policy_key, *_ = jax.random.split(key, 4)
    env = without_reset_noise(drawn_once(env, jax.random.fold_in(reset_key, 1)))
    state = jax.jit(env.reset)(reset_key)
    states, actions = _episode(env, script, state, policy_key, num_steps)
    return record_states(
        env, [state.physics for state in states], actions, key, every=every, camera=camera, num_points=num_points,
        noise=noise, occlusion=occlusion, source=source,
    )  # fmt: skip


def record_states(
    env: Any,
    states: Sequence[Any],
    actions: np.ndarray,
    key: Key,
    *,
    every: int = 1,
    camera: Camera | None = None,
    num_points: int = 256,
    noise: float = 0.0,
    occlusion: float = 0.0,
    source: str = "",
) -> Record:
    """A record of states that are known, for example those of another simulator.

    Args:
      env: one environment with ``particles`` and ``world``, which shows what states look like.
      states: the ``physics`` of each state: before the first action and after each.
      actions: shape (num_steps, num_actions).
      key: of noise and occlusion. With the key of ``record`` they are the same.
      every, camera, num_points, noise, occlusion, source: as in ``record``.

    Raises:
      ValueError: an option is illegal, or the numbers of states and actions do not match.
    """
    _check_options(occlusion, noise, every)
    if len(states) != len(actions) + 1:
        raise ValueError(
            f"there are {len(states)} states with {len(actions)} actions: give one before the first and one after each"
        )
    *_, noise_key, hide_key = jax.random.split(key, 4)
    up = np.asarray(env.up)
    camera = camera_for(np.asarray(points_of(env, states[0])), up) if camera is None else camera
    if noise > 0.0 and camera.noise is not None:
        raise ValueError(f"noise is {noise}, and the camera has noise of its own: give one of them")
    camera = camera.replace(noise=DepthNoise(constant=noise)) if noise > 0.0 else camera
    if camera.body is not None:
        raise ValueError(
            f"body {camera.body} carries the camera, but a record is seen by one that stands still: give a camera "
            "with body=None"
        )
    body = soft_labels(env.world(states[0], up).names, _robot(env))
    frames = list(range(0, len(actions) + 1, every))
    clouds, masks = [], []
    for n in frames:
        seen = _view(env, camera, states[n], tuple(up.tolist()))
        depth = np.asarray(camera.with_noise(seen.depth, jax.random.fold_in(noise_key, n)))
        chosen = np.isin(np.asarray(seen.label), body)
        chosen &= ~_hidden(np.asarray(camera.points(seen.depth)), chosen, occlusion, hide_key)
        cloud, mask = cloud_of_depth(camera, depth, num_points, chosen=chosen)
        clouds.append(cloud)
        masks.append(mask)
    joints = [s.joint_q for s in states] if hasattr(states[0], "joint_q") else None
    dt = float(env.control_dt)
    return Record(
        times=np.asarray(frames) * dt, clouds=np.stack(clouds), mask=np.stack(masks), actions=np.asarray(actions),
        control_dt=dt, joint_q=None if joints is None else np.asarray(joints), camera=camera_numbers(camera),
        source=source,
    )  # fmt: skip


def soft_labels(names: Sequence[str], robot: Sequence[str]) -> list[int]:
    """Which of the names in a world are neither a tool, nor the floor, nor a body of the robot.

    ``with_robot`` gives a body of the robot that has a name of the world the name with ``_2`` behind it.
    """
    others = {"tool", "floor", *(f"{name}_2" if f"{name}_2" in names else name for name in robot)}
    return [i for i, name in enumerate(names) if name not in others]


def _robot(env: Any) -> list[str]:
    """Names of the bodies of an environment's robot, the world's among them; empty if it has none."""
    model = getattr(getattr(env, "unwrapped", env), "model", None)
    return [body_name(model, i) for i in range(model.static.mj.nbody)] if isinstance(model, RigidModel) else []


def _check_options(occlusion: float, noise: float, every: int) -> None:
    if not 0.0 <= occlusion < 1.0:
        raise ValueError(f"occlusion is {occlusion}: give a share of at least 0 and below 1")
    check_number("noise", noise, NOT_NEGATIVE, "give a standard deviation in metres")
    if every < 1:
        raise ValueError(f"every is {every}: give 1 for every step, 2 for every second one")


def camera_for(points: np.ndarray, up: np.ndarray, *, pixels: int = 64) -> Camera:
    """A camera that sees a body obliquely from above, from three times its size away.

    Args:
      points: of the body [m], shape (n, 3).
      up: unit vector, shape (3,).
    """
    center, size = points.mean(0), float(np.ptp(points, axis=0).max())
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    eye = center + 3.0 * size * (0.75 * up + 0.66 * side / np.linalg.norm(side))
    return Camera.look_at(
        center,
        eye=eye,
        up=up,
        height=pixels,
        width=pixels,
        near=0.5 * size,
        far=10.0 * size,
        field_of_view=32.0,
    )


def _episode(env: Any, script: Script, state: Any, key: Key, num_steps: int | None) -> tuple[list[Any], np.ndarray]:
    policy = script if callable(script) else None
    count = (num_steps or env.episode_length) if policy else len(script)  # type: ignore[arg-type]
    states, actions = [state], []
    for n in range(count):
        action = policy(state, jax.random.fold_in(key, n)) if policy else jnp.asarray(script[n], jnp.float32)  # type: ignore[index]
        state = _step(env, state, action)
        bits = int(state.status)
        if bits & FATAL:
            raise ValueError(
                f"step {n} of the record has status {describe(bits)}: give shorter substeps or other actions"
            )
        states.append(state)
        actions.append(np.asarray(action))
    return states, np.asarray(actions, np.float32)


@jax.jit
def _step(env: Any, state: Any, action: Array) -> Any:
    """A control step; environments of one structure share the program."""
    return env.step(state, action)


@functools.partial(jax.jit, static_argnames="up")
def _view(env: Any, camera: Camera, physics: Any, up: tuple[float, ...]) -> Any:
    return camera.view(env.world(physics, np.asarray(up)))


def _hidden(points: np.ndarray, chosen: np.ndarray, share: float, key: Key) -> np.ndarray:
    """Pixels whose points lie beyond a plane that hides a share of the chosen ones, shape (height, width), bool."""
    if share == 0.0 or not chosen.any():
        return np.zeros_like(chosen)
    direction = np.asarray(jax.random.normal(key, (3,)))
    along = points @ direction
    return along > np.quantile(along[chosen], 1.0 - share)


__all__ = ["Script", "camera_for", "record", "record_states", "soft_labels"]
