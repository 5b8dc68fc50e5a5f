"""The triangles of a cloth for contact with points: which points are close, and how triangles share edges and corners.

Gradient: none; which pairs are close is a constant.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.by_content import ByContent
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.thin import closest
from rewax.physics.thin.broad_phase import box_levels, boxes_of, first_true
from rewax.physics.thin.contact_elements import tree_order
from rewax.types import Array

_ARITY = 4
_MAX_ROOTS = 16
_ROOM = 4
"""Pairs of a point and a box for each point, for which the levels of the tree have room."""
EDGES = ((1, 2), (1, 3), (2, 3))
"""Edges of a triangle, as positions in the list of a point and three corners."""


class TriangleTree(ByContent):
    """Triangles, their order in space, and the shares of their edges and corners; hashable, for a static field.

    Attributes:
      triangles: vertices, int32 of shape (num_triangles, 3).
      num_vertices: number of vertices.
      order: triangles along the tree, see ``contact_elements.tree_order``.
      levels: number of levels below the roots.
      shares: for the edges and the corners of each triangle, how often its triangle counts them, (num_triangles, 6).
    """

    def __init__(self, triangles: np.ndarray, vertices: np.ndarray) -> None:
        self.triangles = np.asarray(triangles, np.int32)
        self.num_vertices = len(vertices)
        self.levels = 0
        while len(self.triangles) > _MAX_ROOTS * _ARITY**self.levels:
            self.levels += 1
        centers = np.asarray(vertices, np.float64)[self.triangles].mean(axis=1)
        self.order = tree_order(centers, _ARITY**self.levels)
        self.shares = shares(self.triangles)
        super().__init__(self.triangles.tobytes(), self.num_vertices, self.order.tobytes())

    def __repr__(self) -> str:
        return f"TriangleTree({len(self.triangles)} triangles)"


def shares(triangles: np.ndarray) -> np.ndarray:
    """Weights of the edges and corners of triangles that count each point of a surface once, (num_triangles, 6).

    A sum over all triangles counts an edge of n triangles n times. With these weights it is counted n - (n - 1) = 1
    time, and likewise a corner with its triangles and edges.

    Source: Li et al. 2023, Convergent incremental potential contact, inclusion and exclusion of edges and corners.
    """
    corners = np.asarray(triangles, int)
    pairs = np.sort(corners[:, [[a - 1, b - 1] for a, b in EDGES]], axis=2)
    unique, which, around = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True, return_counts=True)
    of_edge = around[which.reshape(-1)].reshape(-1, 3)
    size = corners.max(initial=-1) + 1
    triangles_at = np.bincount(corners.reshape(-1), minlength=size)
    extra = np.zeros(size, int)
    np.add.at(extra, unique.reshape(-1), np.repeat(around - 1, 2))
    of_corner = (1.0 - triangles_at + extra) / np.maximum(triangles_at, 1)
    return np.concatenate([-(of_edge - 1) / of_edge, of_corner[corners]], axis=1)


class ClosePairs(NamedTuple):
    """Points and triangles in a list of fixed length."""

    points: Array
    triangles: Array
    """Indices, int32 of shape (capacity,); 0 beyond the last pair."""
    valid: Array
    """Whether an entry is a pair, shape (capacity,); pairs come first."""
    num_pairs: Array
    """Number of pairs, int32 of shape (); above the capacity, some are missing."""
    full: Array
    """Whether pairs are missing, shape (), bool."""


def close_to_triangles(tree: TriangleTree, points: Vec3, x: Vec3, reach: Array, capacity: int) -> ClosePairs:
    """Pairs of a point and a triangle closer than ``reach`` [m].

    Each point descends the tree of boxes; each level keeps a list of fixed length.

    Args:
      tree: the triangles.
      points: positions [m], components of shape (num_points,).
      x: positions of the vertices [m], components of shape (num_vertices,).
      capacity: length of the list.
    """
    at, x_at, reach = jax.lax.stop_gradient((jnp.stack(points), jnp.stack(x), reach))
    levels = box_levels(boxes_of(x_at, tree.triangles, reach), tree.order, tree.levels)
    num_points = at.shape[1]
    i, j = (jnp.asarray(k.reshape(-1)) for k in np.indices((num_points, levels[-1].lower.shape[1])))
    valid, full = jnp.bool_(True), jnp.bool_(False)
    for level in reversed(range(tree.levels + 1)):
        boxes = levels[level]
        inside = valid
        for k in cp.AXES:
            inside = inside & (boxes.lower[k][j] <= at[k][i]) & (at[k][i] <= boxes.upper[k][j])
        room = min(i.size, max(_ROOM * num_points, 2 * capacity))
        where, valid, count = first_true(inside, room)
        i, j, full = i[where], j[where], full | (count > room)
        if level:
            i = jnp.repeat(i, _ARITY)
            j = (_ARITY * j[:, None] + jnp.arange(_ARITY)).reshape(-1)
            valid = jnp.repeat(valid, _ARITY)
    order = jnp.asarray(np.maximum(tree.order, 0))
    i, j = jnp.where(valid, i, 0), jnp.where(valid, order[j], 0)
    corners = jnp.asarray(tree.triangles.T)[:, j]
    own = tuple(cp.vector(lambda k, c=c: c[k]) for c in (at[:, i], *(x_at[:, c] for c in corners)))
    gap = cp.norm(closest.weighted(closest.vertex_triangle(own), own))
    room = min(capacity, i.size)
    where, found, count = first_true(valid & (gap < reach), room)
    pad = (0, capacity - room)
    i, j = (jnp.pad(jnp.where(found, k[where], 0), pad) for k in (i, j))
    i, j = i.astype(jnp.int32), j.astype(jnp.int32)
    return ClosePairs(i, j, jnp.pad(found, pad), count, full | (count > capacity))


__all__ = ["EDGES", "ClosePairs", "TriangleTree", "close_to_triangles", "shares"]
