"""Rigid shapes as triangle meshes in their own frame, and the pose of that frame, for the player and the live view."""

from typing import NamedTuple

import numpy as np

from rewax.viz.shapes import KEYS, Drawing

_AROUND, _ALONG = 28, 14
"""Vertices around a round shape, and rings of vertices from pole to pole (an even number)."""
_CREASE = 40.0
"""Faces of a mesh that meet at a larger angle than this have a sharp edge between them [degrees]."""


class Mesh(NamedTuple):
    """A surface.

    Attributes:
      vertices: [m], shape (num_vertices, 3).
      normals: outward, of unit length, shape (num_vertices, 3).
      triangles: counter-clockwise seen from outside, shape (num_triangles, 3).
    """

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray


def mesh(drawing: Drawing) -> Mesh:
    """The surface of a shape that is not a plane; the axis of round shapes is y."""
    kind = drawing["kind"]
    if kind == "mesh":
        return _creased(np.asarray(drawing["vertices"], float), np.asarray(drawing["triangles"], int))
    if kind == "box":
        return _box(np.asarray(drawing["half_size"], float))
    if kind == "ellipsoid":
        ball, semi_axes = _capsule(1.0, 0.0), np.asarray(drawing["semi_axes"], float)
        return Mesh(semi_axes * ball.vertices, _unit(ball.normals / semi_axes), ball.triangles)
    radius = float(drawing["radius"])
    if kind in ("cylinder", "cone"):
        return _cylinder(radius, float(drawing["half_length"]), radius if kind == "cylinder" else 0.0)
    return _capsule(radius, 0.0 if kind == "sphere" else float(drawing["half_length"]))


def pose(drawing: Drawing) -> tuple[np.ndarray, np.ndarray]:
    """Position [m], shape (3,), and orientation of a shape's own frame, a unit quaternion (x, y, z, w)."""
    center = np.asarray(drawing["center"], float)
    if "rotation" in KEYS[drawing["kind"]]:
        return center, _quaternion(np.asarray(drawing["rotation"], float))
    if drawing["kind"] == "sphere":
        return center, np.array([0.0, 0.0, 0.0, 1.0])
    axis = np.asarray(drawing["direction"], float)
    x, y, z = axis / np.linalg.norm(axis)
    if y < -1.0 + 1e-9:
        return center, np.array([1.0, 0.0, 0.0, 0.0])
    turn = np.array([z, 0.0, -x, 1.0 + y])  # the shortest turn from y to the axis
    return center, turn / np.linalg.norm(turn)


def _box(half_size: np.ndarray) -> Mesh:
    vertices, normals, triangles = [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = sign * np.eye(3)[axis]
            first = np.eye(3)[(axis + 1) % 3]
            second = np.cross(normal, first)
            start = 4 * len(normals)
            vertices += [half_size * (normal + a * first + b * second) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            normals.append(np.tile(normal, (4, 1)))
            triangles += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    return Mesh(np.stack(vertices), np.concatenate(normals), np.array(triangles))


def _capsule(radius: float, half_length: float) -> Mesh:
    """A sphere whose halves are moved apart along y."""
    polar = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _ALONG + 1)
    polar = np.concatenate([polar[: _ALONG // 2 + 1], polar[_ALONG // 2 :]])  # both halves have the equator
    end = np.repeat([-half_length, half_length], len(polar) // 2)
    around = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
    directions = np.stack(
        [
            np.cos(polar)[:, None] * np.cos(around),
            np.broadcast_to(np.sin(polar)[:, None], (len(polar), _AROUND)),
            -np.cos(polar)[:, None] * np.sin(around),
        ],
        axis=-1,
    )
    vertices = radius * directions + end[:, None, None] * np.eye(3)[1]
    return Mesh(vertices.reshape(-1, 3), directions.reshape(-1, 3), _rings(len(polar)))


def _cylinder(radius: float, half_length: float, top: float) -> Mesh:
    """With another radius at its upper end; 0 makes a cone."""
    around = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
    ring = np.stack([np.cos(around), np.zeros(_AROUND), -np.sin(around)], axis=-1)
    up = np.eye(3)[1]
    ends = [(-1.0, radius), (1.0, top)]
    side = np.concatenate([size * ring + sign * half_length * up for sign, size in ends])
    slope = _unit(2.0 * half_length * ring + (radius - top) * up)
    parts = [Mesh(side, np.tile(slope, (2, 1)), _rings(2))]
    for sign, size in ends[: 2 if top else 1]:
        rim = np.concatenate([np.zeros((1, 3)), size * ring]) + sign * half_length * up
        index = np.arange(_AROUND)
        after = 1 + (index + 1) % _AROUND
        fan = np.stack([0 * index, 1 + index, after] if sign > 0 else [0 * index, after, 1 + index], axis=1)
        parts.append(Mesh(rim, np.tile(sign * up, (len(rim), 1)), fan))
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    triangles = np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=True)])
    return Mesh(np.concatenate([p.vertices for p in parts]), np.concatenate([p.normals for p in parts]), triangles)


def _creased(vertices: np.ndarray, triangles: np.ndarray) -> Mesh:
    """A mesh with normals: round where its faces meet at small angles, with a vertex for each side of an edge."""
    vertices, index = np.unique(vertices, axis=0, return_inverse=True)  # files may repeat vertices for every face
    triangles = index.reshape(-1)[triangles]
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    areas = np.cross(b - a, c - a)  # twice the area, along the face's normal
    triangles, areas = triangles[areas.any(axis=1)], areas[areas.any(axis=1)]
    faces = _unit(areas)
    corners = triangles.reshape(-1)
    order = np.argsort(corners, kind="stable")  # corners 3 f + i, those of one vertex side by side
    count = np.bincount(corners, minlength=len(vertices))
    start = np.cumsum(count) - count
    normals = np.zeros((len(corners), 3))
    for turn in range(int(count.max())):  # each corner with the first, the second, ... corner at its vertex
        some = np.flatnonzero(turn < count[corners])
        other = order[start[corners[some]] + turn] // 3
        near = np.einsum("ni,ni->n", faces[some // 3], faces[other]) > np.cos(np.radians(_CREASE))
        normals[some[near]] += areas[other[near]]
    normals = np.round(_unit(normals), 6)
    _, first, index = np.unique(np.column_stack([corners, normals]), axis=0, return_index=True, return_inverse=True)
    return Mesh(vertices[corners[first]], _unit(normals[first]), index.reshape(-1, 3))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Normalise vectors of shape (n, 3); zero vectors stay zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


def _rings(count: int) -> np.ndarray:
    """Triangles between rings of corners, each around y, one above the other."""
    row, column = (a.reshape(-1) for a in np.mgrid[: count - 1, :_AROUND])
    here, right = row * _AROUND + column, row * _AROUND + (column + 1) % _AROUND
    lower = np.stack([here, right, right + _AROUND], axis=1)
    upper = np.stack([here, right + _AROUND, here + _AROUND], axis=1)
    return np.concatenate([lower, upper])


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """(x, y, z, w) of a rotation matrix: the eigenvector of Bar-Itzhack 2000, exact for rotations."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    return np.linalg.eigh(matrix)[1][:, -1]


__all__ = ["Mesh", "mesh", "pose"]
