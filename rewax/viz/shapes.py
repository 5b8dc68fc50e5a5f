"""Rigid shapes as pictures need them: how far they reach, and their outlines seen from a direction."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

Shape: TypeAlias = Mapping[str, Any]
"""A rigid shape in metres: ``kind``, ``centre`` (3,), and

``"sphere"``: ``radius``.
``"capsule"``, a cylinder with round ends, and ``"cylinder"``: ``radius``, ``half_length`` and ``direction`` (3,).
``"box"``: ``half_sizes`` (3,) and ``rotation`` (3, 3), whose columns are its axes.
``"plane"``: ``direction`` (3,), its normal; it bounds what is solid and has no end.
"""
KINDS = ("sphere", "capsule", "cylinder", "box", "plane")


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


def check_kind(shape: Shape) -> None:
    """Raise a ValueError for a shape that cannot be drawn."""
    if shape["kind"] not in KINDS:
        raise ValueError(f"cannot draw a shape of kind {shape['kind']!r}: use one of {', '.join(map(repr, KINDS))}")


def support(shape: Shape, directions: np.ndarray) -> np.ndarray:
    """The point of a shape, not a plane, that lies farthest in each direction.

    Args:
      shape: convex.
      directions: unit vectors, shape (..., 3).

    Returns:
      Points [m], shape (..., 3).
    """
    check_kind(shape)
    kind, centre = shape["kind"], np.asarray(shape["centre"], float)
    if kind == "box":
        axes = np.asarray(shape["rotation"], float)
        return centre + (np.sign(directions @ axes) * np.asarray(shape["half_sizes"], float)) @ axes.T
    radius = float(shape["radius"])
    if kind == "sphere":
        return centre + radius * directions
    axis = np.asarray(shape["direction"], float)
    axis = axis / np.linalg.norm(axis)
    along = (directions @ axis)[..., None]
    end = centre + float(shape["half_length"]) * np.sign(along) * axis
    if kind == "capsule":
        return end + radius * directions
    across = directions - along * axis
    return end + radius * across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)


def outline(shape: Shape, view: View, *, num_points: int = 96) -> np.ndarray:
    """The silhouette of a shape, not a plane, counter-clockwise in the picture, shape (num_points, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, num_points, endpoint=False)[:, None]
    return view.project(support(shape, np.cos(angle) * view.right + np.sin(angle) * view.up))


def bounds(shapes: Sequence[Shape]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the smallest box, along the world's axes, around shapes that are not planes, shape (3,) each.

    Infinite, the lower one above, where there are none.
    """
    solid = [shape for shape in shapes if shape["kind"] != "plane"]
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for shape in solid:
        low = np.minimum(low, np.diagonal(support(shape, -np.eye(3))))
        high = np.maximum(high, np.diagonal(support(shape, np.eye(3))))
    return low, high


__all__ = ["KINDS", "Shape", "View", "bounds", "check_kind", "outline", "side_view", "support"]
