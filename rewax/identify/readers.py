"""Records from a folder of PLY files and a CSV file with the tool's path."""

import csv
import re
from pathlib import Path
from typing import Any

import numpy as np

from rewax.envs.kit.set_points import Following
from rewax.identify.record_checks import check_record
from rewax.identify.records import Record, padded

_NEAR = 1e-3
"""Distance up to which two positions of a joint are the same [m, rad]; also the excess of an action beyond 1."""


def read_folder(
    folder: str | Path, tool_path: str | Path, env: Any, *, num_points: int = 512, scale: float = 1.0
) -> Record:
    """A record from clouds in PLY files and joint positions of the tool in a CSV file.

    The number in a file's name is its time in microseconds, ``cloud_0050000.ply``, or, if a file ``times.csv`` with
    the columns ``file,time`` lies beside them, its time stands there [s]. The first column of the tool's path is time
    [s], the others are the joint positions of ``env``; positions between its rows are interpolated.

    Args:
      folder: with the clouds, in the frame of the environment.
      tool_path: CSV file with a heading; time 0 is that of the first action.
      env: a task whose actions move joints by ``joint_step``; it gives the control step.
      num_points: largest size of a cloud; larger ones are thinned.
      scale: factor from the files' unit of length to metres: 0.001 for millimetres.

    Raises:
      ValueError: in one sentence: files are missing or cannot be read, the frames span less than a control step (they
        may be numbered, not named by microseconds), the environment's joints cannot follow the
        path, or ``check_record`` finds a fault.
    """
    _check_joints(env)
    files, times = _files_and_times(Path(folder))
    if len(times) > 1 and times[-1] < float(env.control_dt):
        raise ValueError(
            f"the last of {len(times)} frames in {str(folder)!r} is at {times[-1]:g} s, within the first control step "
            f"of {float(env.control_dt):g} s: name the files by microseconds, or add a file times.csv with the columns "
            "file and time in seconds"
        )
    clouds, masks = zip(*(padded(scale * _points(path), num_points) for path in files), strict=True)
    joint_q = tool_joints(tool_path, env, times[-1])
    record = Record(
        times=times, clouds=np.stack(clouds), mask=np.stack(masks), actions=actions_of(env, joint_q),
        control_dt=float(env.control_dt), joint_q=joint_q, source=str(folder),
    )  # fmt: skip
    check_record(record)
    return record


def _check_joints(env: Any) -> None:
    """Raises ValueError unless the environment has joints that actions move along a path."""
    missing = [name for name in ("joint_start", "joint_step", "joint_lower", "joint_upper") if not hasattr(env, name)]
    if missing:
        raise ValueError(
            f"{type(env).__name__} has no {missing[0]}: give a task whose actions move the joints of a tool by "
            "joint_step, such as RollingFlat, without Randomized around it"
        )


def tool_joints(path: str | Path, env: Any, end: float) -> np.ndarray:
    """Joint positions at the control steps up to a time [m, rad], shape (num_steps + 1, num_joints)."""
    rows = _numbers(Path(path))
    joints = len(np.asarray(env.joint_start))
    if rows.shape[1] != joints + 1:
        raise ValueError(f"{str(path)!r} has {rows.shape[1]} columns: give time and {joints} joint positions")
    if len(rows) < 2 or not np.all(np.diff(rows[:, 0]) > 0.0):
        raise ValueError(f"the times of {str(path)!r} do not rise: sort its rows, and drop doubles")
    if rows[0, 0] > 1e-9 or rows[-1, 0] < end - 1e-6:
        raise ValueError(
            f"{str(path)!r} covers {rows[0, 0]:g} to {rows[-1, 0]:g} s: give the tool's path from 0 to {end:g} s"
        )
    dt = float(env.control_dt)
    at = dt * np.arange(int(np.ceil(end / dt - 1e-6)) + 1)
    return np.stack([np.interp(at, rows[:, 0], rows[:, i + 1]) for i in range(joints)], axis=1)


def actions_of(env: Any, joint_q: np.ndarray) -> np.ndarray:
    """Actions that move an environment's joints along a path, shape (num_steps, num_joints).

    Raises:
      ValueError: the path does not begin at ``joint_start``, leaves ``joint_lower`` and ``joint_upper``, or is faster
        than ``joint_step`` allows; or the joints follow set points.
    """
    _check_joints(env)
    bare = getattr(env, "unwrapped", env)
    if isinstance(bare, Following):
        raise ValueError(
            f"the joints of {type(bare).__name__} follow set points, so no actions move them along a path: choose a "
            "task whose actions move joints by joint_step"
        )
    gap = np.abs(joint_q[0] - np.asarray(env.joint_start)).max()
    if gap > _NEAR:
        raise ValueError(
            f"the tool's path begins {gap:.3g} from joint_start: give the environment joint_start={joint_q[0].tolist()}"
        )
    # joint_start may lie beyond a limit: the first step then moves the joint to it.
    low, high = joint_q[1:].min(0), joint_q[1:].max(0)
    beyond = max((np.asarray(env.joint_lower) - low).max(), (high - np.asarray(env.joint_upper)).max())
    if beyond > _NEAR:
        raise ValueError(
            f"the tool's path goes {beyond:.3g} beyond joint_lower or joint_upper, where the simulated tool stops: "
            f"give the environment joint_lower of at most {low.tolist()} and joint_upper of at least {high.tolist()}"
        )
    moved, step = np.diff(joint_q, axis=0), np.asarray(env.joint_step)
    stays = np.abs(moved) <= np.where(step > 0.0, 0.0, _NEAR)
    with np.errstate(divide="ignore", invalid="ignore"):
        actions = np.where(stays, 0.0, moved / step)
    if np.abs(actions).max() > 1.0 + _NEAR:
        raise ValueError(
            f"the tool's path is {np.abs(actions).max():.2f} times as fast as joint_step allows: give the environment "
            "a larger joint_step"
        )
    return np.clip(actions, -1.0, 1.0).astype(np.float32)


def _files_and_times(folder: Path) -> tuple[list[Path], np.ndarray]:
    found = sorted(folder.glob("*.ply"))
    if not found:
        raise ValueError(f"there are no PLY files in {str(folder)!r}: give a folder with one for each frame")
    listed = folder / "times.csv"
    if listed.is_file():
        with listed.open(newline="") as file:
            by_name = {row["file"]: row["time"] for row in csv.DictReader(file) if {"file", "time"} <= row.keys()}
        if missing := [path.name for path in found if path.name not in by_name]:
            raise ValueError(f"{str(listed)!r} has no time for {missing[0]}: give the columns file and time")
        times = [_number(by_name[path.name], listed) for path in found]
    else:
        numbers = [re.search(r"(\d+)\D*$", path.stem) for path in found]
        if not all(numbers) or any(re.search(r"\d[.,]\d+\D*$", path.stem) for path in found):
            raise ValueError(
                f"the names of the PLY files in {str(folder)!r} are no times in microseconds: add a file times.csv"
            )
        times = [1e-6 * int(number[1]) for number in numbers if number]
    order = np.argsort(times, kind="stable")
    return [found[i] for i in order], np.asarray(times, float)[order]


def _points(path: Path) -> np.ndarray:
    try:
        import trimesh
    except ImportError:
        raise ValueError("reading PLY files needs trimesh: pip install 'rewax[meshes]'") from None
    try:
        points = np.asarray(trimesh.load(path).vertices, float)  # pyright: ignore[reportAttributeAccessIssue]
    except Exception as error:  # trimesh raises many kinds
        raise ValueError(f"{str(path)!r} cannot be read as PLY: {error}") from None
    return points.reshape(-1, 3)


def _numbers(path: Path) -> np.ndarray:
    if not path.is_file():
        raise ValueError(f"there is no tool path {str(path)!r}: give a CSV file with time and joint positions")
    with path.open(newline="") as file:
        rows = [row for row in csv.reader(file) if row][1:]
    if not rows or len({len(row) for row in rows}) > 1:
        raise ValueError(f"{str(path)!r} has no rows of equal length below a heading: give time and joint positions")
    return np.array([[_number(value, path) for value in row] for row in rows])


def _number(text: str, path: Path) -> float:
    try:
        return float(text)
    except (TypeError, ValueError):
        raise ValueError(f"{str(path)!r} holds {text!r}: give numbers below one heading") from None


__all__ = ["actions_of", "read_folder", "tool_joints"]
