"""A record: what a camera saw of a body while a known tool moved. One documented file format, npz.

| array | shape | |
|---|---|---|
| ``version`` | () | 1 |
| ``units`` | () | ``"m,s"`` |
| ``times`` | (T,) | of the frames [s], rising; 0 is the time of the first action |
| ``clouds`` | (T, N, 3) | seen points in the world [m] |
| ``mask`` | (T, N) | which of them exist, bool |
| ``actions`` | (A, num_actions) | one for each control step |
| ``control_dt`` | () | duration of a control step [s] |
| ``joint_q`` | (A + 1, num_joints) | optional: joint positions of the tool before the first and after each step |
| ``camera`` | (15,) | optional: position, rotation row by row, vertical field of view [degrees], height, width |
| ``source`` | () | optional: where the record comes from |

A depth picture becomes a cloud by ``cloud_of_depth``.
"""

import dataclasses
import zipfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from rewax.sensors.camera import ZOOM, Camera
from rewax.whole_files import replacing

VERSION = 1
UNITS = "m,s"
_NEEDED = ("version", "units", "times", "clouds", "mask", "actions", "control_dt")
_OPTIONAL = ("joint_q", "camera", "source")


@dataclasses.dataclass(frozen=True, eq=False)
class Record:
    """See the module's table; arrays of NumPy."""

    times: np.ndarray
    clouds: np.ndarray
    mask: np.ndarray
    actions: np.ndarray
    control_dt: float
    joint_q: np.ndarray | None = None
    camera: np.ndarray | None = None
    source: str = ""
    units: str = UNITS
    version: int = VERSION

    @property
    def num_frames(self) -> int:
        return len(self.times)

    @property
    def frame_steps(self) -> np.ndarray:
        """Times of the frames in control steps, shape (num_frames,); they need not be whole."""
        return np.asarray(self.times) / self.control_dt

    def first(self, seconds: float) -> "Record":
        """The frames up to a time, and the actions that lead there."""
        keep = np.asarray(self.times) <= seconds + 1e-9
        steps = int(np.ceil(self.frame_steps[keep].max() - 1e-6)) if keep.any() else 0
        joint_q = None if self.joint_q is None else self.joint_q[: steps + 1]
        return dataclasses.replace(
            self, times=self.times[keep], clouds=self.clouds[keep], mask=self.mask[keep], joint_q=joint_q,
            actions=self.actions[: max(steps, 1)],
        )  # fmt: skip


def save(record: Record, path: str | Path) -> Path:
    """Write a record; returns the path. ``.npz`` is appended to one that does not end so.

    Raises:
      ValueError: ``check_record`` finds a fault.
    """
    from rewax.identify.record_checks import check_record

    check_record(record)
    path = Path(path)
    path = path if path.suffix == ".npz" else path.with_name(f"{path.name}.npz")
    fields = dataclasses.asdict(record)
    arrays: dict[str, Any] = {name: np.asarray(value) for name, value in fields.items() if value is not None}
    with replacing(path) as unfinished:
        np.savez_compressed(unfinished, **arrays)
    return path


def load(path: str | Path) -> Record:
    """Read and check a record.

    Raises:
      ValueError: there is no such file, it is no record, or ``check_record`` finds a fault.
    """
    from rewax.identify.record_checks import check_record

    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no record {str(path)!r}: give a file that `rewax record` or `save` wrote")
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
    except (OSError, ValueError, TypeError, AttributeError, zipfile.BadZipFile, EOFError):
        raise ValueError(f"{str(path)!r} is no npz file, or holds objects: give a file of arrays") from None
    if missing := [name for name in _NEEDED if name not in found]:
        raise ValueError(f"{str(path)!r} lacks {', '.join(missing)}: a record has {', '.join(_NEEDED)}")
    known: dict[str, Any] = {name: found[name] for name in (*_NEEDED, *_OPTIONAL) if name in found}
    for name, kind in (("control_dt", float), ("version", int), ("units", str), ("source", str)):
        if name in known:
            try:
                known[name] = kind(known[name][()])
            except (TypeError, ValueError, OverflowError):
                raise ValueError(f"{name} of the record is {known[name]!r}: give one {kind.__name__}") from None
    record = Record(**known)
    check_record(record)
    return record


def camera_numbers(camera: Camera) -> np.ndarray:
    """The numbers of a camera as a record holds them, shape (15,)."""
    rotation = np.asarray(camera.rotation, float).reshape(-1)
    angle = camera.field_of_view
    if camera.zoom is not None:  # a record holds the angle that is seen
        angle = np.degrees(2.0 * np.arctan(np.tan(np.radians(angle) / 2.0) / np.clip(camera.zoom, *ZOOM)))
    return np.concatenate([np.asarray(camera.position, float), rotation, [angle, camera.height, camera.width]])


def camera_of(numbers: np.ndarray, **fields: Any) -> Camera:
    """The camera of a record. ``fields`` are others of ``Camera``: ``near``, ``far``, ``gradient``."""
    position, rotation = jnp.asarray(numbers[:3], jnp.float32), jnp.asarray(numbers[3:12], jnp.float32).reshape(3, 3)
    return Camera(
        position=position, rotation=rotation, field_of_view=float(numbers[12]), height=int(numbers[13]),
        width=int(numbers[14]), **fields,
    )  # fmt: skip


def cloud_of_depth(camera: Camera, depth: np.ndarray, num_points: int, *, chosen: np.ndarray | None = None) -> Any:
    """Points of a depth picture: evenly chosen pixels that see something.

    Args:
      camera: that took it, standing still.
      depth: [m], shape (height, width); ``camera.far`` or more, or not finite, where nothing was seen.
      num_points: largest size of the cloud.
      chosen: pixels of the body, shape (height, width), bool; None: all that see something.

    Returns:
      Points [m], shape (num_points, 3), and which of them exist, shape (num_points,).
    """
    depth = np.asarray(depth)
    seen = np.isfinite(depth) & (depth < camera.far) & (depth > 0.0)
    seen = seen if chosen is None else seen & chosen
    points = np.asarray(camera.points(jnp.where(seen, depth, camera.far)))[seen]
    return padded(points, num_points)


def padded(points: np.ndarray, num_points: int) -> tuple[np.ndarray, np.ndarray]:
    """A cloud of a fixed size: every n-th of the points, or all and zeros; and which exist."""
    if len(points) > num_points:
        points = points[np.linspace(0, len(points) - 1, num_points).round().astype(int)]
    cloud, mask = np.zeros((num_points, 3), np.float32), np.zeros(num_points, bool)
    cloud[: len(points)], mask[: len(points)] = points, True
    return cloud, mask


__all__ = [
    "UNITS", "VERSION", "Record", "camera_numbers", "camera_of", "cloud_of_depth", "load", "padded", "save",
]  # fmt: skip
