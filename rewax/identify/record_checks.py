"""Checks of a record; each fault gets one sentence."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.history import History
from rewax.envs.kit.soft_task import SoftTask
from rewax.envs.sensing import Sensing
from rewax.identify.records import UNITS, VERSION, Record
from rewax.physics.contact.colliders import MIN_INFLUENCE, shape_pose
from rewax.physics.numerics.arguments import check_instance
from rewax.physics.numerics.checks import POSITIVE, static_number
from rewax.physics.numerics.pose import body_pose
from rewax.physics.shapes import signed_distance

_SMALLEST, _LARGEST = 1e-3, 50.0
"""Plausible extents of a cloud [m]: smaller ones may be metres for what are kilometres, larger ones millimetres."""
_MIN_POINTS = 8
_SAME_PATH = 1e-3
"""Largest distance of a recorded joint from where the actions lead it [m, rad]."""


def check_record(record: Record) -> None:
    """Raises ValueError for the first fault, with its remedy."""
    check_instance("record", record, Record, "give a Record, load(path) for example")
    if record.version != VERSION:
        raise ValueError(f"version of the record is {record.version}: this rewax reads {VERSION}")
    if record.units != UNITS:
        raise ValueError(f"units of the record are {record.units!r}: convert to metres and seconds, {UNITS!r}")
    _check_shapes(record)
    _check_times(record)
    _check_clouds(record)


def _check_shapes(record: Record) -> None:
    arrays: dict[str, tuple[Any, int]] = {
        "times": (record.times, 1),
        "clouds": (record.clouds, 3),
        "mask": (record.mask, 2),
        "actions": (record.actions, 2),
    }
    optional = {"joint_q": (record.joint_q, 2), "camera": (record.camera, 1)}
    arrays |= {name: value for name, value in optional.items() if value[0] is not None}
    for name, (value, rank) in arrays.items():
        if np.ndim(value) != rank:
            raise ValueError(f"{name} of the record has shape {np.shape(value)}: give {rank} axes")
        if name != "mask" and (np.iscomplexobj(value) or not np.issubdtype(np.asarray(value).dtype, np.number)):
            raise ValueError(f"{name} of the record is of type {np.asarray(value).dtype}: give real numbers")
    frames = len(record.times)
    if frames < 2:
        raise ValueError(f"the record has {frames} frames: give at least 2, the first of the body at rest")
    if record.clouds.shape[0] != frames or record.clouds.shape[2] != 3:
        raise ValueError(f"clouds has shape {record.clouds.shape} with {frames} times: give ({frames}, num_points, 3)")
    if record.mask.shape != record.clouds.shape[:2]:
        raise ValueError(f"mask has shape {record.mask.shape}: give that of the clouds, {record.clouds.shape[:2]}")
    if record.mask.dtype != bool:
        raise ValueError(f"mask is of type {record.mask.dtype}: give booleans, True where a point exists")
    if record.joint_q is not None and len(record.joint_q) != len(record.actions) + 1:
        raise ValueError(
            f"joint_q has {len(record.joint_q)} rows with {len(record.actions)} actions: give one before the first "
            "action and one after each"
        )
    if record.camera is not None and np.shape(record.camera) != (15,):
        raise ValueError(f"camera has shape {np.shape(record.camera)}: give 15 numbers, see rewax.identify.records")


def _check_times(record: Record) -> None:
    remedy = "give the seconds between two actions"
    dt = static_number("control_dt of the record", record.control_dt, POSITIVE, remedy)
    times = np.asarray(record.times, float)
    for name in ("times", "actions", "joint_q", "camera"):
        value = getattr(record, name)
        if value is not None and not np.all(np.isfinite(value)):
            raise ValueError(f"{name} of the record holds a number that is not finite: leave that frame or step out")
    if times[0] < 0.0:
        raise ValueError(f"the first frame is at {times[0]:g} s: count time from the first action")
    if not np.all(np.diff(times) > 0.0):
        i = int(np.argmin(np.diff(times) > 0.0))
        raise ValueError(f"times do not rise: {times[i]:g} s, then {times[i + 1]:g} s; sort the frames, drop doubles")
    end = len(record.actions) * dt
    if times[-1] > end * (1.0 + 1e-6) + 1e-9:
        raise ValueError(
            f"the last frame is at {times[-1]:g} s, but {len(record.actions)} actions end at {end:g} s: give "
            "actions up to it"
        )
    if times[0] > dt * (1.0 + 1e-6):
        raise ValueError(
            f"the first frame is at {times[0]:g} s, after the first step of {dt:g} s: give a frame of the body at rest"
        )


def _check_clouds(record: Record) -> None:
    counts = record.mask.sum(1)
    if counts.min() < _MIN_POINTS:
        i = int(np.argmin(counts))
        raise ValueError(
            f"frame {i} shows {counts[i]} points: leave out frames with fewer than {_MIN_POINTS}, empty "
            "clouds say nothing"
        )
    if not np.all(np.isfinite(record.clouds[record.mask])):
        i = int(np.argmax(~np.isfinite(np.where(record.mask[..., None], record.clouds, 0.0)).all((1, 2))))
        raise ValueError(
            f"the cloud of frame {i} holds a number that is not finite: set the mask of such points to False"
        )
    seen = record.clouds[record.mask]
    extent = float(np.ptp(np.quantile(seen, [0.02, 0.98], axis=0), axis=0).max())
    if not _SMALLEST < extent < _LARGEST:
        raise ValueError(
            f"the clouds extend over {extent:.3g} m, which is no plausible body: are they in millimetres? Give metres"
        )


def check_against(record: Record, env: Any, particles: np.ndarray) -> None:
    """Raises ValueError if a record does not fit an environment.

    Args:
      record: checked.
      env: the environment of the fit.
      particles: its points after a reset [m], shape (num_particles, 3).
    """
    wanted = env.action_spec.shape
    if record.actions.shape[1:] != wanted:
        raise ValueError(
            f"actions has shape {record.actions.shape}, but the environment takes {wanted} each: give those"
        )
    dt = getattr(env, "control_dt", None)
    if dt is not None and abs(dt / record.control_dt - 1.0) > 1e-3:
        raise ValueError(
            f"control_dt of the record is {record.control_dt:g} s, that of the environment {dt:g} s: make the "
            "environment with dt and num_substeps of that product"
        )
    if not np.any(record.actions) and (record.joint_q is None or not np.ptp(record.joint_q, axis=0).any()):
        raise ValueError("the tool does not move in this record: push the body, what rests says little")
    _check_path(record, env)
    size = float(np.ptp(particles, axis=0).max())
    first = record.clouds[0][record.mask[0]]
    gap = float(np.linalg.norm(np.median(first, axis=0) - np.median(particles, axis=0)))
    if gap > 2.0 * size:
        raise ValueError(
            f"the first cloud is {gap:.3g} m from the simulated body, whose size is {size:.3g} m: give both in one "
            "frame and unit"
        )
    near = tool_distance(record, env)
    grid = getattr(getattr(getattr(env, "unwrapped", env), "scene", None), "grid", None)
    reach = 0.0 if grid is None else float(grid.spacing)
    if near is not None and near > 0.1 * size + reach:
        raise ValueError(f"the tool never touches: it stays {near:.3g} m from all seen points; record a push that does")


def _check_path(record: Record, env: Any) -> None:
    """Raises ValueError if the actions of a record lead the joints of an environment along another path than its own.

    Only joints that ``SoftTask.advance`` moves are compared, not those behind a wrapper that may change actions.
    """
    while isinstance(env, (Sensing, History)):
        env = env.env
    if record.joint_q is None or getattr(type(env), "advance", None) is not SoftTask.advance:
        return
    q = np.asarray(env.joint_start, float)
    lower, upper, step = (np.asarray(a, float) for a in (env.joint_lower, env.joint_upper, env.joint_step))
    path = [q]
    for action in np.clip(record.actions[:, : len(q)], -1.0, 1.0):
        q = np.clip(q + step * action, lower, upper)
        path.append(q)
    if np.shape(record.joint_q) != np.shape(path):
        raise ValueError(f"joint_q has shape {np.shape(record.joint_q)}: give one number for each of {len(q)} joints")
    gap = np.abs(record.joint_q - np.stack(path)).max(1, initial=0.0)
    if gap.max() > _SAME_PATH:
        i = int(np.argmax(gap > _SAME_PATH))
        raise ValueError(
            f"after {i} steps the actions lead the tool {gap[i]:.3g} away from joint_q of the record: give the "
            "environment the joint_start, joint_lower, joint_upper and joint_step with which it was recorded"
        )


def tool_distance(record: Record, env: Any) -> float | None:
    """Smallest distance of seen points from a tool's surface [m]; None if the record or the environment has no tool.

    The tool is that of every step, because it may touch between two frames; points are those of the frames around it.
    """
    bare = getattr(env, "unwrapped", env)
    colliders = getattr(getattr(bare, "scene", None), "colliders", ())
    if record.joint_q is None or not colliders or not callable(getattr(bare, "poses", None)):
        return None
    steps, last = np.arange(len(record.joint_q)), len(record.clouds) - 1
    before = np.clip(np.searchsorted(record.frame_steps, steps + 0.5) - 1, 0, last)
    frames = np.concatenate([before, np.minimum(before + 1, last)])
    bodies = bare.poses(jnp.asarray(record.joint_q[np.tile(steps, 2)], jnp.float32))

    def nearest(bodies: Any, cloud: Any, mask: Any) -> Any:
        distances = []
        for collider in colliders:
            pose = shape_pose(collider, body_pose(bodies, collider.body))
            distances.append(
                jnp.where(
                    mask, signed_distance(collider.shape, (cloud - pose.position) @ pose.rotation)[0], jnp.inf
                ).min()
            )
        return jnp.stack(distances).min()

    clouds = jnp.asarray(np.where(record.mask[..., None], record.clouds, 0.0), jnp.float32)
    return float(jax.jit(jax.vmap(nearest))(bodies, clouds[frames], jnp.asarray(record.mask)[frames]).min())


def tool_remarks(env: Any) -> list[str]:
    """A sentence if the contact of a tool reaches less than half a cell: the values then depend on the grid."""
    scene = getattr(getattr(env, "unwrapped", env), "scene", None)
    spacing = getattr(getattr(scene, "grid", None), "spacing", None)
    softness = [np.max(c.softness) for c in getattr(scene, "colliders", ()) if c.softness is not None]
    if spacing is None or not softness:
        return []
    reach, cell = -math.log(MIN_INFLUENCE) / float(max(softness)), float(spacing)
    if reach >= 0.5 * cell:
        return []
    return [
        f"The contact of a tool reaches {1e3 * reach:.2g} mm and a cell of the grid is {1e3 * cell:.2g} mm: the body "
        "sinks into the tool, and the values depend on the grid. For real material give Collider(softness=None)."
    ]


def check_frame_weights(weights: Any, num_frames: int) -> None:
    """Raises ValueError unless the weights of the frames are None, or numbers of at least 0, not all 0."""
    if weights is not None and (
        np.shape(weights) != (num_frames,)
        or not np.all(np.isfinite(weights))
        or np.min(weights) < 0
        or not np.any(weights)
    ):
        raise ValueError(f"frame_weights is {weights!r}: give {num_frames} numbers of at least 0, not all 0")


__all__ = ["check_against", "check_frame_weights", "check_record", "tool_distance", "tool_remarks"]
