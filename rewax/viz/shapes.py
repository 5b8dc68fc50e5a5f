"""Drawings of rigid shapes, as environments give them to pictures: their keys, extents and outlines.

A drawing is a mapping. ``kind`` says what is drawn; every kind has ``center``, and its own keys:

============  ===================================  =========================================================
kind          keys                                 meaning
============  ===================================  =========================================================
``sphere``    ``radius``
``capsule``   ``radius, half_length, direction``   a cylinder with round ends, which ``half_length`` excludes
``cylinder``  ``radius, half_length, direction``
``box``       ``half_size, rotation``              the columns of ``rotation`` are the box's axes
``plane``     ``direction``                        the solid lies on the side opposite to ``direction``
============  ===================================  =========================================================

``center``: [m], shape (3,); of a plane, any point of it. ``radius`` and ``half_length``: [m], shape (). ``half_size``:
half the edges along the box's axes [m], shape (3,). ``direction``: of the axis or the normal, shape (3,), of any length
but zero. ``rotation``: shape (3, 3). Videos and the player also use ``color`` (red, green and blue between 0 and 1,
shape (3,)) and ``opacity`` (between 0 and 1) where they are given. Other keys are ignored.
"""

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

Drawing: TypeAlias = Mapping[str, Any]
"""A rigid shape in a picture; the table above lists its keys."""

_SHAPES: dict[str, tuple[int, ...]] = {
    "center": (3,),
    "radius": (),
    "half_length": (),
    "half_size": (3,),
    "direction": (3,),
    "rotation": (3, 3),
    "color": (3,),
    "opacity": (),
}
KEYS: dict[str, tuple[str, ...]] = {
    "sphere": ("center", "radius"),
    "capsule": ("center", "radius", "half_length", "direction"),
    "cylinder": ("center", "radius", "half_length", "direction"),
    "box": ("center", "half_size", "rotation"),
    "plane": ("center", "direction"),
}
"""Keys of a drawing by its kind, besides ``kind``."""


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """A parallel projection: which directions of the world point to the right and up in the picture.

    Attributes:
      right, up: orthogonal unit vectors, shape (3,).
    """

    right: np.ndarray
    up: np.ndarray

    @property
    def towards(self) -> np.ndarray:
        """Unit vector from the picture to the eye, shape (3,)."""
        return np.cross(self.right, self.up)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Places in the picture of points (..., 3), shape (..., 2)."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)


def side_view(up: Sequence[float] | np.ndarray = (0.0, 1.0, 0.0)) -> View:
    """A level view with x to the right, or y where x points up.

    Args:
      up: unit vector, shape (3,).
    """
    up = np.asarray(up, float)
    level = np.eye(3) - np.outer(up, up)
    right = level[0] if np.linalg.norm(level[0]) > 0.1 else level[1]
    return View(right / np.linalg.norm(right), up)


def check_drawing(drawing: Drawing) -> None:
    """Check kind, keys and numbers of a drawing.

    Raises:
      ValueError: a sentence that names the kind or key, what it is and what it may be.
    """
    if not isinstance(drawing, Mapping):
        raise ValueError(f"a drawing is {drawing!r}: give a dict with kind, center and the keys of that kind")
    kind = drawing.get("kind")
    if not isinstance(kind, str) or kind not in KEYS:
        raise ValueError(f"cannot draw a shape of kind {kind!r}: use one of {', '.join(map(repr, KEYS))}")
    for key in KEYS[kind]:
        if key not in drawing:
            others = [given for given in drawing if given not in KEYS[kind] and given != "kind"]
            close = difflib.get_close_matches(key, others, n=1)
            instead = f", but has {close[0]!r}" if close else ""
            raise ValueError(f"the drawing of a {kind} has no {key!r}{instead}: give it {', '.join(KEYS[kind])}")
        _check_numbers(kind, key, drawing[key])
    for key in ("color", "opacity"):
        if key in drawing:
            _check_numbers(kind, key, drawing[key])


def _check_numbers(kind: str, key: str, value: Any) -> None:
    """Shape, finiteness and sign of one entry."""
    try:
        numbers = np.asarray(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"{key} of the drawing of a {kind} is {value!r}: give numbers") from None
    name = f"{key} of the drawing of a {kind}"
    if numbers.shape != _SHAPES[key]:
        raise ValueError(f"{name} has shape {numbers.shape}: give {_SHAPES[key]}")
    if not np.isfinite(numbers).all():
        raise ValueError(f"{name} is {numbers.tolist()}: give finite numbers")
    if key in ("radius", "half_length", "half_size") and not (numbers >= 0.0).all():
        raise ValueError(f"{name} is {numbers.tolist()}: give 0 or more")
    if key in ("color", "opacity") and not ((numbers >= 0.0) & (numbers <= 1.0)).all():
        raise ValueError(f"{name} is {numbers.tolist()}: give numbers from 0 to 1")
    if key == "direction" and not numbers.any():
        raise ValueError(f"{name} is zero: give a vector of any other length")


def check_cloud(particles: Any) -> np.ndarray:
    """Particle positions [m] as float64, shape (num_particles, 3).

    Raises:
      ValueError: they have another shape or are not finite.
    """
    cloud = np.asarray(particles, np.float64)
    if cloud.ndim != 2 or cloud.shape[1] != 3 or not len(cloud):
        raise ValueError(f"particles have shape {cloud.shape}: give (num_particles, 3)")
    if not np.isfinite(cloud).all():
        raise ValueError("particles hold a number that is not finite: draw finite positions only")
    return cloud


def support(drawing: Drawing, directions: np.ndarray) -> np.ndarray:
    """The point of a shape, not a plane, that lies farthest in each direction.

    Args:
      drawing: of a convex shape.
      directions: unit vectors, shape (..., 3).

    Returns:
      Points [m], shape (..., 3).

    Raises:
      ValueError: kind or keys are wrong.
    """
    check_drawing(drawing)
    kind, center = drawing["kind"], np.asarray(drawing["center"], float)
    if kind == "box":
        axes = np.asarray(drawing["rotation"], float)
        return center + (np.sign(directions @ axes) * np.asarray(drawing["half_size"], float)) @ axes.T
    radius = float(drawing["radius"])
    if kind == "sphere":
        return center + radius * directions
    axis = np.asarray(drawing["direction"], float)
    axis = axis / np.linalg.norm(axis)
    along = (directions @ axis)[..., None]
    end = center + float(drawing["half_length"]) * np.sign(along) * axis
    if kind == "capsule":
        return end + radius * directions
    across = directions - along * axis
    return end + radius * across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)


def outline(drawing: Drawing, view: View, *, num_points: int = 96) -> np.ndarray:
    """The silhouette of a shape, not a plane, counter-clockwise in the picture, shape (num_points, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, num_points, endpoint=False)[:, None]
    return view.project(support(drawing, np.cos(angle) * view.right + np.sin(angle) * view.up))


def bounds(drawings: Sequence[Drawing]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the smallest box, along the world's axes, around shapes that are not planes, shape (3,) each.

    Infinite, the lower one above, where there are none.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for drawing in drawings:
        check_drawing(drawing)
        if drawing["kind"] != "plane":
            low = np.minimum(low, np.diagonal(support(drawing, -np.eye(3))))
            high = np.maximum(high, np.diagonal(support(drawing, np.eye(3))))
    return low, high


__all__ = ["KEYS", "Drawing", "View", "bounds", "check_cloud", "check_drawing", "outline", "side_view", "support"]
