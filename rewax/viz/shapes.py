"""Drawings of rigid shapes, as environments give them to pictures: their keys, extents and outlines.

A drawing is a mapping. ``kind`` says what is drawn; every kind has ``center``, and its own keys:

=============  ==================================  ================================================================
kind           keys                                meaning
=============  ==================================  ================================================================
``sphere``     ``radius``
``ellipsoid``  ``semi_axes, rotation``             the columns of ``rotation`` are the axes
``capsule``    ``radius, half_length, direction``  a cylinder with round ends, which ``half_length`` excludes
``cylinder``   ``radius, half_length, direction``
``cone``       ``radius, half_length, direction``  the tip lies at ``center`` + ``half_length`` along ``direction``
``box``        ``half_size, rotation``             the columns of ``rotation`` are the box's axes
``mesh``       ``vertices, triangles, rotation``   counter-clockwise seen from outside; the same in all frames
``plane``      ``direction``                       the solid lies on the side opposite to ``direction``
=============  ==================================  ================================================================

``center``: [m], shape (3,); of a plane, any point of it. ``radius`` and ``half_length``: [m], shape (). ``half_size``:
half the edges along the box's axes [m], shape (3,). ``semi_axes``: half the extents along the ellipsoid's axes [m],
shape (3,), > 0. ``direction``: of the axis or the normal, shape (3,), of any length but zero. ``rotation``: shape
(3, 3). ``vertices``: in the mesh's own frame, whose origin is ``center`` [m], shape (num_vertices, 3). ``triangles``:
indices of vertices, shape (num_triangles, 3). A recording keeps vertices and triangles once if they are numpy arrays.
Videos and the player also use ``color`` (red, green and blue between 0 and 1, shape (3,)) and ``opacity`` (between 0
and 1) where they are given. Other keys are ignored.
"""

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

Drawing: TypeAlias = Mapping[str, Any]
"""A rigid shape in a picture; the table above lists its keys."""

_SHAPES: dict[str, tuple[int | None, ...]] = {
    "center": (3,),
    "radius": (),
    "half_length": (),
    "half_size": (3,),
    "semi_axes": (3,),
    "direction": (3,),
    "rotation": (3, 3),
    "vertices": (None, 3),
    "triangles": (None, 3),
    "color": (3,),
    "opacity": (),
}
KEYS: dict[str, tuple[str, ...]] = {
    "sphere": ("center", "radius"),
    "ellipsoid": ("center", "semi_axes", "rotation"),
    "capsule": ("center", "radius", "half_length", "direction"),
    "cylinder": ("center", "radius", "half_length", "direction"),
    "cone": ("center", "radius", "half_length", "direction"),
    "box": ("center", "half_size", "rotation"),
    "mesh": ("center", "vertices", "triangles", "rotation"),
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
        """Picture coordinates of points (..., 3), shape (..., 2)."""
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


def turned(drawing: Drawing, rotation: np.ndarray) -> Drawing:
    """A drawing turned about the origin by a rotation matrix, shape (3, 3)."""
    found = {"center", "direction", "rotation"} & drawing.keys()
    return {**drawing, **{key: rotation @ np.asarray(drawing[key], float) for key in found}}


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
            raise ValueError(f"the drawing of {_a(kind)} has no {key!r}{instead}: give it {', '.join(KEYS[kind])}")
        _check_numbers(kind, key, drawing[key])
    for key in ("color", "opacity"):
        if key in drawing:
            _check_numbers(kind, key, drawing[key])
    if kind == "mesh":
        _check_triangles(np.asarray(drawing["triangles"], float), len(drawing["vertices"]))


def _check_numbers(kind: str, key: str, value: Any) -> None:
    """Check the shape, finiteness and sign of one entry."""
    try:
        numbers = np.asarray(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"{key} of the drawing of {_a(kind)} is {value!r}: give numbers") from None
    name = f"{key} of the drawing of {_a(kind)}"
    _check_shape(name, numbers.shape, _SHAPES[key])
    if not np.isfinite(numbers).all():
        problem = f"is {numbers.tolist()}" if numbers.size <= 9 else "holds a number that is not finite"
        raise ValueError(f"{name} {problem}: give finite numbers")
    if key in ("radius", "half_length", "half_size") and not (numbers >= 0.0).all():
        raise ValueError(f"{name} is {numbers.tolist()}: give 0 or more")
    if key == "semi_axes" and not (numbers > 0.0).all():
        raise ValueError(f"{name} is {numbers.tolist()}: give more than 0")
    if key in ("color", "opacity") and not ((numbers >= 0.0) & (numbers <= 1.0)).all():
        raise ValueError(f"{name} is {numbers.tolist()}: give numbers from 0 to 1")
    if key == "direction" and not numbers.any():
        raise ValueError(f"{name} is zero: give a vector of any other length")


def _a(kind: str) -> str:
    return f"an {kind}" if kind == "ellipsoid" else f"a {kind}"


def _check_shape(name: str, shape: tuple[int, ...], wanted: tuple[int | None, ...]) -> None:
    """Check the shape of one entry; None stands for any size above 0."""
    if len(shape) != len(wanted) or any(
        n != m if m is not None else n == 0 for n, m in zip(shape, wanted, strict=True)
    ):
        expected = ", ".join("n" if n is None else str(n) for n in wanted) + ("," if len(wanted) == 1 else "")
        raise ValueError(f"{name} has shape {shape}: give ({expected})" + (" with n > 0" if None in wanted else ""))


def _check_triangles(triangles: np.ndarray, num_vertices: int) -> None:
    wrong = triangles[(triangles < 0) | (triangles >= num_vertices) | (triangles != np.floor(triangles))]
    if len(wrong):
        raise ValueError(
            f"triangles of the drawing of a mesh holds {wrong[0]:g}: give integers from 0 to {num_vertices - 1}, "
            "indices of its vertices"
        )


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
      drawing: of a shape; a mesh, which need not be convex, has the points of its convex hull.
      directions: unit vectors, shape (..., 3).

    Returns:
      Points [m], shape (..., 3).

    Raises:
      ValueError: kind or keys are wrong.
    """
    check_drawing(drawing)
    kind, center = drawing["kind"], np.asarray(drawing["center"], float)
    if "rotation" in KEYS[kind]:
        axes = np.asarray(drawing["rotation"], float)
        return center + _own_support(drawing, directions @ axes) @ axes.T
    radius = float(drawing["radius"])
    if kind == "sphere":
        return center + radius * directions
    axis = np.asarray(drawing["direction"], float)
    axis = axis / np.linalg.norm(axis)
    along = (directions @ axis)[..., None]
    tip = float(drawing["half_length"]) * axis
    if kind == "capsule":
        return center + np.sign(along) * tip + radius * directions
    across = directions - along * axis
    rim = radius * across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    if kind == "cylinder":
        return center + np.sign(along) * tip + rim
    at_tip = (directions * (2.0 * tip - rim)).sum(axis=-1, keepdims=True) > 0.0
    return center + np.where(at_tip, tip, rim - tip)


def _own_support(drawing: Drawing, directions: np.ndarray) -> np.ndarray:
    """``support`` of a shape that has a rotation, in its own frame."""
    if drawing["kind"] == "box":
        return np.sign(directions) * np.asarray(drawing["half_size"], float)
    if drawing["kind"] == "ellipsoid":
        scaled = directions * np.asarray(drawing["semi_axes"], float)
        return scaled / np.linalg.norm(scaled, axis=-1, keepdims=True) * np.asarray(drawing["semi_axes"], float)
    vertices = np.asarray(drawing["vertices"], float)
    return vertices[np.argmax(directions @ vertices.T, axis=-1)]


def placed(drawing: Drawing, points: np.ndarray) -> np.ndarray:
    """Points of the frame of a shape that has a rotation, in the world [m], shapes (..., 3)."""
    return np.asarray(drawing["center"], float) + points @ np.asarray(drawing["rotation"], float).T


def outline(drawing: Drawing, view: View, *, num_points: int = 96) -> np.ndarray:
    """The silhouette of a shape, not a plane, counter-clockwise in the picture, shape (num_points, 2).

    Of a mesh it is that of its convex hull.
    """
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


__all__ = [
    "KEYS", "Drawing", "View", "bounds", "check_cloud", "check_drawing", "outline", "placed", "side_view", "support",
]  # fmt: skip
