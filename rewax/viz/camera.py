"""The perspective camera of a picture, and how it is placed to show a whole recording."""

import dataclasses
from typing import Any

import numpy as np

from rewax.viz.recording import Recording, diameters
from rewax.viz.shapes import bounds, side_view

FIELD_OF_VIEW = 35.0
"""Vertical field of view [degrees]."""
_FILLED = 0.86
"""Largest share of the picture's width or height that the scene may fill."""
_DEFAULTS: dict[str, Any] = {"azimuth": 25.0, "elevation": 22.0, "zoom": 1.0, "follow": None}


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """A camera.

    Attributes:
      eye: its position [m], shape (3,).
      right, up, forward: unit vectors; ``forward`` is the direction of view, shape (3,) each.
      distance: from the eye to the target [m].
    """

    eye: np.ndarray
    right: np.ndarray
    up: np.ndarray
    forward: np.ndarray
    distance: float

    def project(self, points: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Columns, rows and depths [m] of points of shape (..., 3) in a picture of so many pixels."""
        offset = np.asarray(points) - self.eye
        depth = offset @ self.forward
        scale = focal_length(height) / np.maximum(depth, 1e-6)
        return 0.5 * width + scale * (offset @ self.right), 0.5 * height - scale * (offset @ self.up), depth


def focal_length(height: int) -> float:
    """Focal length in pixels: the size of an object of 1 m at a distance of 1 m, for a picture of ``height`` rows."""
    return 0.5 * height / np.tan(np.radians(0.5 * FIELD_OF_VIEW))


def look(target: np.ndarray, *, up: np.ndarray, azimuth: float, elevation: float, distance: float) -> Camera:
    """A camera that looks at a point.

    Args:
      target: the point [m], shape (3,).
      up: unit vector that points up in the world, shape (3,).
      azimuth: 0 looks along the depth of a side view (x to the right); positive goes to the right around it [degrees].
      elevation: above the horizon, below 90 [degrees].
      distance: of the eye from the target [m].
    """
    side = side_view(up)
    turn, tilt = np.radians(azimuth), np.radians(np.clip(elevation, -89.0, 89.0))
    level = np.cos(turn) * side.towards + np.sin(turn) * side.right
    towards = np.cos(tilt) * level + np.sin(tilt) * side.up
    right = np.cross(side.up, towards)
    right = right / np.linalg.norm(right)
    return Camera(
        eye=np.asarray(target) + distance * towards,
        right=right,
        up=np.cross(towards, right),
        forward=-towards,
        distance=distance,
    )


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Framing:
    """Placement of the camera for a recording.

    Attributes:
      targets: point that the camera looks at in each frame [m], shape (num_frames, 3).
      distance: of the eye from the target [m].
      azimuth, elevation: of the eye [degrees].
      radius: of a ball about the target that holds the scene [m].
      floor: height of the floor along ``up`` [m].
      follow: whether the target moves.
    """

    targets: np.ndarray
    distance: float
    azimuth: float
    elevation: float
    radius: float
    floor: float
    follow: bool

    def camera(self, frame: int, up: np.ndarray) -> Camera:
        """The camera of a frame."""
        return look(self.targets[frame], up=up, azimuth=self.azimuth, elevation=self.elevation, distance=self.distance)


def frame_recording(recording: Recording, *, aspect: float = 4 / 3) -> Framing:
    """Choose a camera that shows everything that happens.

    Args:
      recording: its ``camera`` may hold ``azimuth`` and ``elevation`` [degrees], ``zoom`` (above 1 is nearer) and
        ``follow``: whether the camera goes with what moves. By default it does where things travel further than twice
        their own size.
      aspect: width of the picture divided by its height.

    Raises:
      ValueError: ``camera`` has an unknown key, a number that is not finite, or a zoom that is not positive.
    """
    return frame_boxes(recording, boxes_of(recording), aspect)


def frame_both(recording: Recording, *, aspect: float = 4 / 3) -> tuple[Framing, Framing, bool]:
    """The camera that follows, the one that stands still, and whether ``frame_recording`` chooses the first."""
    boxes = boxes_of(recording)
    followed, still = (frame_boxes(recording, boxes, aspect, follow=follow) for follow in (True, False))
    return followed, still, _follows(recording, boxes)


def _options(recording: Recording) -> dict[str, Any]:
    options = {**_DEFAULTS, **recording.camera}
    if unknown := sorted(set(options) - set(_DEFAULTS)):
        raise ValueError(f"camera has an unknown key {unknown[0]!r}: use {', '.join(_DEFAULTS)}")
    for name in ("azimuth", "elevation", "zoom"):
        if not _is_finite(options[name]):
            raise ValueError(f"camera has {name} {options[name]!r}: give a finite number")
    if float(options["zoom"]) <= 0.0:
        raise ValueError(f"camera has zoom {options['zoom']}: give a number above 0, 1 fits everything in")
    return options


def _is_finite(value: Any) -> bool:
    try:
        return bool(np.isfinite(float(value)))
    except (TypeError, ValueError):
        return False


def boxes_of(recording: Recording) -> np.ndarray:
    """Lower and upper corners of what each frame shows [m], shape (num_frames, 2, 3)."""
    margin = 0.0 if recording.particles is None else 0.5 * float(diameters(recording).max())
    return np.stack([np.stack(_box(recording, i, margin)) for i in range(recording.num_frames)])


def _follows(recording: Recording, boxes: np.ndarray) -> bool:
    """Whether the camera goes with what moves."""
    follow = _options(recording)["follow"]
    if follow is not None:
        return bool(follow)
    size = float(np.median(np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=1)))
    return float(np.linalg.norm(np.ptp(boxes.mean(axis=1), axis=0))) > 2.0 * size


def frame_boxes(recording: Recording, boxes: np.ndarray, aspect: float, *, follow: bool | None = None) -> Framing:
    """``frame_recording`` for boxes of other frames than the recording's own, shape (num_frames, 2, 3) [m].

    ``follow`` says whether the camera goes with what moves; None decides as ``frame_recording`` does.
    """
    options = _options(recording)
    follow = _follows(recording, boxes) if follow is None else follow
    middles, sizes = boxes.mean(axis=1), boxes[:, 1] - boxes[:, 0]
    if follow:
        targets, radius = _smooth(middles), 0.6 * float(np.linalg.norm(sizes, axis=1).max())
    else:
        low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
        targets = np.broadcast_to(0.5 * (low + high), middles.shape)
        radius = 0.5 * float(np.linalg.norm(high - low))
    radius = max(radius, 1e-3)  # a point has none; the grid on the floor needs a scale
    azimuth, elevation = float(options["azimuth"]), float(options["elevation"])
    direction = look(np.zeros(3), up=recording.up, azimuth=azimuth, elevation=elevation, distance=1.0)
    distance = _fitting_distance(boxes - targets[:, None], direction, aspect) / float(options["zoom"])
    return Framing(
        targets=targets,
        distance=distance,
        azimuth=azimuth,
        elevation=elevation,
        radius=radius,
        floor=_floor(recording, boxes),
        follow=follow,
    )


def _fitting_distance(boxes: np.ndarray, camera: Camera, aspect: float) -> float:
    """Smallest distance of the eye at which all boxes lie in the picture.

    Args:
      boxes: lower and upper corners relative to the target [m], shape (num_frames, 2, 3).
      camera: gives the directions.
      aspect: width of the picture divided by its height.
    """
    corners = _corners(boxes)
    tangent = _FILLED * np.tan(np.radians(0.5 * FIELD_OF_VIEW))
    nearness = -(corners @ camera.forward)
    across, upwards = np.abs(corners @ camera.right) / (tangent * aspect), np.abs(corners @ camera.up) / tangent
    reach = float(np.linalg.norm(corners, axis=1).max())
    return max(float((nearness + np.maximum(across, upwards)).max()), 1.5 * reach, 1e-3)


def in_picture(framing: Framing, recording: Recording, box: np.ndarray, aspect: float) -> bool:
    """Whether the camera of the first frame shows a box of shape (1, 2, 3) [m]; ``zoom`` does not matter."""
    whole = dataclasses.replace(framing, distance=framing.distance * float(_options(recording)["zoom"]))
    columns, rows, depths = whole.camera(0, np.asarray(recording.up, float)).project(_corners(box), 1, 1)
    across, upwards = np.abs(columns - 0.5), np.abs(rows - 0.5)
    return bool(depths.min() > 0.0 and across.max() <= 0.5 * aspect and upwards.max() <= 0.5)


def _corners(boxes: np.ndarray) -> np.ndarray:
    """All corners of boxes of shape (n, 2, 3), shape (8 n, 3)."""
    picks = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
    return np.concatenate([np.where(pick, boxes[:, 1], boxes[:, 0]) for pick in picks])


def _box(recording: Recording, frame: int, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner around a frame's particles, with a margin, and its shapes without planes [m]."""
    low, high = bounds(recording.shapes(frame))
    if recording.particles is not None:
        cloud = recording.particles[frame]
        low, high = np.minimum(low, cloud.min(axis=0) - margin), np.maximum(high, cloud.max(axis=0) + margin)
    return low, high


def _floor(recording: Recording, corners: np.ndarray) -> float:
    """Height of the floor: the recording's own, that of the highest level plane, or the lowest point."""
    if recording.floor is not None:
        return float(recording.floor)
    up = np.asarray(recording.up, float)
    heights = []
    for shape in recording.shapes(0):
        if shape["kind"] == "plane":
            normal = np.asarray(shape["direction"], float)
            if normal @ up > 0.99 * np.linalg.norm(normal):
                heights.append(float(np.asarray(shape["center"], float) @ up))
    lowest = float((np.where(up > 0, corners[:, 0], corners[:, 1]) * up).sum(axis=1).min())
    return max(heights) if heights else lowest


def _smooth(path: np.ndarray) -> np.ndarray:
    """A smoothed path: the mean over a window of about a tenth of its length; a short path stays as it is.

    Frames of a short path are far apart, so a mean over them would lie beside what each of them shows.
    """
    width = len(path) // 20
    padded = np.concatenate([np.repeat(path[:1], width, 0), path, np.repeat(path[-1:], width, 0)])
    sums = np.cumsum(np.concatenate([np.zeros((1, 3)), padded]), axis=0)
    return (sums[2 * width + 1 :] - sums[: -2 * width - 1]) / (2 * width + 1)


__all__ = [
    "FIELD_OF_VIEW", "Camera", "Framing", "boxes_of", "focal_length", "frame_both", "frame_boxes", "frame_recording",
    "in_picture", "look",
]  # fmt: skip
