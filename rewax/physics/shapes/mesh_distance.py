"""Distances to triangles and winding numbers at the nodes of a grid, in numpy."""

import itertools
from typing import Any

import numpy as np

from rewax.physics.numerics import components as cp

BLOCK = 4
"""Nodes along each edge of a block; the nodes of a block share candidate faces."""


def distance_on_grid(triangles: np.ndarray, axes: list[np.ndarray]) -> np.ndarray:
    """Distance of each node of a regular grid to the nearest triangle [m].

    A block of nodes tests only faces with a bounding ball near enough to contain the nearest point of any node.

    Args:
      triangles: corners [m], shape (num_faces, 3, 3).
      axes: coordinates of the nodes along x, y, z [m].

    Returns:
      Distances, shape (len(x), len(y), len(z)), exact up to rounding.
    """
    out = np.empty([len(a) for a in axes])
    middle = triangles.mean(axis=1)
    radius = np.linalg.norm(triangles - middle[:, None], axis=2).max(axis=1)
    starts = [range(0, len(a), BLOCK) for a in axes]
    for start in itertools.product(*starts):
        part = [a[s : s + BLOCK] for a, s in zip(axes, start, strict=True)]
        center = np.array([0.5 * (a[0] + a[-1]) for a in part])
        reach = 0.5 * np.linalg.norm([a[-1] - a[0] for a in part])
        to_middle = np.sqrt(np.square(middle - center).sum(axis=1))
        nearest = np.argmin(to_middle + radius)
        bound = np.sqrt(_square_distance(center[:, None, None], triangles[nearest : nearest + 1]))[0, 0]
        near = triangles[to_middle - radius <= bound + 2.0 * reach]
        nodes = np.stack(np.meshgrid(*part, indexing="ij")).reshape(3, -1, 1)
        # 256 faces fit into the processor's cache.
        squares = [_square_distance(nodes, near[k : k + 256]).min(axis=1) for k in range(0, len(near), 256)]
        block = tuple(slice(s, s + BLOCK) for s in start)
        out[block] = np.sqrt(np.min(squares, axis=0)).reshape([len(a) for a in part])
    return out


def _square_distance(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Squared distances of points (3, m, 1) to triangles (k, 3, 3), shape (m, k)."""
    # ``cp`` is annotated for JAX arrays; it works on numpy arrays too.
    corners: list[Any] = [tuple(triangles[:, c, i] for i in range(3)) for c in range(3)]
    p: Any = tuple(points)
    normal = cp.cross(cp.subtract(corners[1], corners[0]), cp.subtract(corners[2], corners[0]))
    length: Any = np.sqrt(cp.dot(normal, normal))
    normal = cp.scale(1.0 / length, normal)
    square, above = np.inf, True
    for c in range(3):
        edge = cp.subtract(corners[(c + 1) % 3], corners[c])
        offset = cp.subtract(p, corners[c])
        along = np.clip(cp.dot(offset, edge) / cp.dot(edge, edge), 0.0, 1.0)
        away = cp.vector(lambda i, o=offset, t=along, e=edge: o[i] - t * e[i])
        square = np.minimum(square, cp.dot(away, away))
        above = above & (cp.dot(offset, cp.cross(normal, edge)) >= 0)
    height = cp.dot(offset, normal)  # pyright: ignore[reportPossiblyUnboundVariable]
    return np.where(above, height * height, square)


def winding_on_grid(triangles: np.ndarray, axes: list[np.ndarray], axis: int) -> np.ndarray:
    """Winding number of triangles around each node, counted along lines parallel to one axis.

    The count rises by one where a line enters through a face and falls by one where it leaves. Lines are offset from
    the nodes by 1e-5 of a cell, so that they meet no edge of a mesh that is aligned with the grid.

    Args:
      triangles: corners [m], shape (num_faces, 3, 3), counterclockwise seen from outside.
      axes: coordinates of the nodes along x, y, z [m], equally spaced.
      axis: 0, 1 or 2.

    Returns:
      Winding numbers, int32, shape (len(x), len(y), len(z)).
    """
    first, second = (axis + 1) % 3, (axis + 2) % 3
    spacing = axes[0][1] - axes[0][0]
    lines = axes[first] + 1.1e-5 * spacing, axes[second] + 1.7e-5 * spacing
    u, v, depth = triangles[..., first], triangles[..., second], triangles[..., axis]
    face, i, j = _lines_in_bounds(u, v, lines)
    along, inside = _crossing(u[face], v[face], depth[face], lines[0][i], lines[1][j])
    i, j, along, sign = i[inside], j[inside], along[inside], -np.sign(_double_area(u, v))[face[inside]]
    k = np.searchsorted(axes[axis], along)
    num = len(axes[axis])
    steps = np.zeros((num + 1, len(lines[0]), len(lines[1])), np.int32)
    np.add.at(steps, (k, i, j), sign.astype(np.int32))
    return np.moveaxis(np.cumsum(steps[:num], axis=0, dtype=np.int32), (0, 1, 2), (axis, first, second))


def _double_area(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])


def _lines_in_bounds(u: np.ndarray, v: np.ndarray, lines: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, ...]:
    """All pairs of a triangle and a line through its bounding rectangle: (face, i, j)."""
    low_i, high_i = (np.searchsorted(lines[0], a) for a in (u.min(axis=1), u.max(axis=1)))
    low_j, high_j = (np.searchsorted(lines[1], a) for a in (v.min(axis=1), v.max(axis=1)))
    width = high_j - low_j
    count = (high_i - low_i) * width
    face = np.repeat(np.arange(len(u)), count)
    rank = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    return face, low_i[face] + rank // width[face], low_j[face] + rank % width[face]


def _crossing(u, v, depth, line_u: np.ndarray, line_v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinate at which lines cross the planes of triangles (n, 3), and whether they cross inside the triangles."""
    du, dv = u - line_u[:, None], v - line_v[:, None]
    # Barycentric coordinates: the weight of corner k is the area spanned by the line and the other two corners.
    weights = np.roll(du, -1, 1) * np.roll(dv, -2, 1) - np.roll(du, -2, 1) * np.roll(dv, -1, 1)
    total = weights.sum(axis=1)
    inside = np.all(weights * np.sign(total)[:, None] > 0, axis=1)
    return (weights * depth).sum(axis=1) / np.where(total == 0, 1.0, total), inside


__all__ = ["distance_on_grid", "winding_on_grid"]
