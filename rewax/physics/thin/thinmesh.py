"""Meshes of cloth (triangles) and ropes (segments): builders, connections, checks."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rewax.physics.numerics.checks import FINITE, POSITIVE
from rewax.physics.numerics.fields import check_fields, check_range, checked, indices, integer, real, static


@dataclass(frozen=True, kw_only=True)
class ThinMesh:
    """Vertices at rest, triangles of cloth and segments of ropes.

    Attributes:
      vertices: [m], shape (num_vertices, 3).
      triangles: int32 of shape (num_triangles, 3).
      segments: int32 of shape (num_segments, 2).
      pattern: flat coordinates of the cloth's vertices at rest [m], warp first, shape (num_vertices, 2); None: the
        vertices themselves are the rest shape, curved or not.
    """

    vertices: np.ndarray
    triangles: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.int32))
    segments: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int32))
    pattern: np.ndarray | None = None


_SIZE = static(POSITIVE, "give a length in metres")


@checked(width=_SIZE, length=_SIZE, num_x=integer(1, "give at least 1"), num_z=integer(1, "give at least 1"))
def sheet(width: float, length: float, num_x: int, num_z: int) -> ThinMesh:
    """A flat rectangle from the origin, ``width`` along x and ``length`` along z, of 2 num_x num_z triangles.

    The diagonals of neighbouring cells alternate. Vertex (i, k) has index i (num_z + 1) + k.
    """
    x, z = np.linspace(0.0, width, num_x + 1), np.linspace(0.0, length, num_z + 1)
    grid = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1).reshape(-1, 2)
    vertices = np.stack([grid[:, 0], np.zeros(len(grid)), grid[:, 1]], axis=-1)
    triangles = []
    for i in range(num_x):
        for k in range(num_z):
            a, b, c, d = np.array([[i, k], [i, k + 1], [i + 1, k + 1], [i + 1, k]]) @ [num_z + 1, 1]
            triangles += [(a, b, c), (a, c, d)] if (i + k) % 2 == 0 else [(a, b, d), (b, c, d)]
    return ThinMesh(vertices=vertices, triangles=np.asarray(triangles, np.int32))


@checked(points=real(FINITE, "give positions in metres", shape=("num_vertices", 3)))
def rope(points: Any) -> ThinMesh:
    """A rope through points [m], shape (num_vertices, 3), in their order."""
    points = np.asarray(points, np.float64)
    first = np.arange(len(points) - 1, dtype=np.int32)
    return ThinMesh(vertices=points, segments=np.stack([first, first + 1], axis=-1))


def hinges(triangles: np.ndarray) -> np.ndarray:
    """Inner edges with the opposite vertices on their left and right, int32 of shape (num_hinges, 4)."""
    left = {(int(t[i]), int(t[(i + 1) % 3])): int(t[(i + 2) % 3]) for t in triangles for i in range(3)}
    found = [(a, b, c, left[b, a]) for (a, b), c in left.items() if a < b and (b, a) in left]
    return np.asarray(found, np.int32).reshape(-1, 4)


def bends(segments: np.ndarray) -> np.ndarray:
    """Consecutive vertices of ropes: those with exactly two segments, in the middle, int32 of shape (num_bends, 3)."""
    ends: dict[int, list[int]] = {}
    for a, b in segments:
        ends.setdefault(int(a), []).append(int(b))
        ends.setdefault(int(b), []).append(int(a))
    found = [(near[0], at, near[1]) for at, near in sorted(ends.items()) if len(near) == 2]
    return np.asarray(found, np.int32).reshape(-1, 3)


_FIELDS = {
    "vertices": real(FINITE, "give positions in metres", shape=("num_vertices", 3)),
    "triangles": indices("give integers of shape (num_triangles, 3)", ("num_triangles", 3)),
    "segments": indices("give integers of shape (num_segments, 2)", ("num_segments", 2)),
}


def check_thinmesh(mesh: ThinMesh) -> None:
    """Raise a ValueError if a mesh has a fault. The message names the fault and the remedy.

    Faults are wrong shapes and indices, vertices without an element, edges of triangles with the same direction twice
    (more than two triangles, or triangles of opposite orientation), flat triangles, segments of no length, and two
    segments between the same vertices.
    """
    check_fields(_FIELDS, vars(mesh))
    vertices, triangles = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.triangles)
    segments, count = np.asarray(mesh.segments), len(mesh.vertices)
    check_range("triangles", triangles, count)
    check_range("segments", segments, count)
    unused = np.setdiff1d(np.arange(count), np.concatenate([triangles.reshape(-1), segments.reshape(-1)]))
    if len(unused):
        raise ValueError(f"vertices has {len(unused)} without an element (the first is {unused[0]}): remove them")
    directed = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    if len(np.unique(directed, axis=0)) < len(directed):
        raise ValueError(
            "triangles have an edge twice in the same direction: give each edge at most two triangles, both "
            "counterclockwise seen from one side"
        )
    flat = vertices
    if mesh.pattern is not None:
        real(FINITE, "give flat coordinates in metres", shape=(count, 2))("pattern", mesh.pattern)
        flat = np.concatenate([np.asarray(mesh.pattern, np.float64), np.zeros((count, 1))], axis=1)
    edges = flat[triangles[:, 1:]] - flat[triangles[:, :1]]
    normal = np.cross(edges[:, 0], edges[:, 1])
    small = np.linalg.norm(normal, axis=-1) <= 1e-6 * np.max(np.sum(edges**2, axis=-1), axis=1, initial=0.0)
    if mesh.pattern is not None and len(normal):
        small |= np.sign(normal[:, 2]) != np.sign(normal[0, 2])
    if small.any():
        raise ValueError(
            f"triangles has {small.sum()} flat or mirrored at rest (the first is {small.argmax()}): remesh"
        )
    if np.any(np.linalg.norm(vertices[segments[:, 1]] - vertices[segments[:, 0]], axis=-1) <= 0):
        raise ValueError("segments has one of no length: merge its vertices")
    if len(np.unique(np.sort(segments, axis=1), axis=0)) < len(segments):
        raise ValueError("segments has two between the same vertices: remove one of them")


__all__ = ["ThinMesh", "bends", "check_thinmesh", "hinges", "rope", "sheet"]
