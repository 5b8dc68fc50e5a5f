"""Elements of self-contact: vertices, edges and triangles, their order in space, and neighbours that do not touch."""

import heapq
import math
from collections import defaultdict
from typing import NamedTuple

import numpy as np

from rewax.lowering.by_content import ByContent
from rewax.physics.thin.stencils import Topology

APART = 1.5
"""Path along the mesh over thickness below which elements are neighbours: a rope of this length, bent as tightly as its
thickness allows, has its ends at a distance of one thickness."""
_ARITY = 4
_MAX_ROOTS = 128


class Kind(NamedTuple):
    """Elements of one kind."""

    corners: np.ndarray
    """Vertices of each, int32 of shape (num_elements, num_corners)."""
    is_rope: np.ndarray
    """Whether each belongs to a rope, shape (num_elements,)."""
    order: np.ndarray
    """Along the tree, see ``tree_order``."""


class ContactElements(ByContent):
    """Elements of self-contact in a scene; hashable, so that it can be a static field.

    Attributes:
      num_vertices: number of vertices.
      edges: edges of triangles and segments of ropes, int32 of shape (num_edges, 2).
      triangles: int32 of shape (num_triangles, 3).
      is_rope: whether an edge is a segment of a rope, shape (num_edges,).
      in_rope: whether a vertex belongs to ropes alone, shape (num_vertices,).
      near_triangles: triangles with which each vertex does not touch, -1 for none, shape (num_vertices, any).
      near_edges: edges with which each edge does not touch, likewise.
      levels: number of levels of the trees below their roots.
      orders: for vertices, edges and triangles, their order along a tree, see ``tree_order``.
    """

    def __init__(self, topology: Topology, vertices: np.ndarray, near: list[set[int]]) -> None:
        self.triangles, segments = topology.triangles.indices, topology.segments.indices
        self.num_vertices = topology.triangles.num_vertices
        self.edges = mesh_edges(topology)
        self.is_rope = np.arange(len(self.edges)) >= len(self.edges) - len(segments)
        self.in_rope = ~np.isin(np.arange(self.num_vertices), self.triangles)
        vertices = np.asarray(vertices, np.float64)
        self.near_triangles = _touching(near, [[v] for v in range(self.num_vertices)], self.triangles)
        self.near_edges = _touching(near, self.edges.tolist(), self.edges)
        kinds = (np.arange(self.num_vertices)[:, None], self.edges, self.triangles)
        largest = max(map(len, kinds))
        self.levels = 0
        while largest > _MAX_ROOTS * _ARITY**self.levels:
            self.levels += 1
        piece = _pieces(self.edges, self.num_vertices)
        shifted = vertices + [10.0 * np.ptp(vertices, axis=0).max(), 0.0, 0.0] * piece[:, None]
        self.orders = tuple(tree_order(shifted[kind].mean(axis=1), _ARITY**self.levels) for kind in kinds)
        self._vertices = np.arange(self.num_vertices, dtype=np.int32)[:, None]
        tables = self.near_triangles.tobytes(), self.near_edges.tobytes()
        super().__init__(topology, *tables, *map(bytes, self.orders))

    def kinds(self, with_triangles: bool) -> tuple["Kind", "Kind"]:
        """Vertices and triangles, or edges twice."""
        vertices, edges, triangles = self.orders
        if not with_triangles:
            both = Kind(self.edges, self.is_rope, edges)
            return both, both
        flat = np.zeros(len(self.triangles), bool)
        return Kind(self._vertices, self.in_rope, vertices), Kind(self.triangles, flat, triangles)

    def capacity(self, with_triangles: bool, pairs_per_element: int) -> int:
        """Length of a list of pairs."""
        return pairs_per_element * (self.num_vertices if with_triangles else len(self.edges))

    def neighbours(self, with_triangles: bool) -> np.ndarray:
        """``near_triangles`` of vertices, or ``near_edges`` of edges."""
        return self.near_triangles if with_triangles else self.near_edges

    def __repr__(self) -> str:
        return (
            f"ContactElements({self.num_vertices} vertices, {len(self.edges)} edges, {len(self.triangles)} triangles)"
        )


def mesh_edges(topology: Topology) -> np.ndarray:
    """Edges of triangles, then segments of ropes, int32 of shape (num_edges, 2)."""
    triangles = topology.triangles.indices
    of_cloth = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    return np.concatenate([of_cloth, topology.segments.indices]).astype(np.int32)


def near_vertices(edges: np.ndarray, vertices: np.ndarray, reach: float) -> tuple[list[set[int]], np.ndarray]:
    """For each vertex those at a path of at most ``reach`` [m] along edges, itself included, and the length of the
    shortest longer path [m], inf if there is none, shape (num_vertices,).

    Source: Dijkstra's algorithm.
    """
    length = np.linalg.norm(vertices[edges[:, 1]] - vertices[edges[:, 0]], axis=-1)
    beside: dict[int, list[tuple[int, float]]] = defaultdict(list)
    for (a, b), size in zip(edges.tolist(), length.tolist(), strict=True):
        beside[a].append((b, size))
        beside[b].append((a, size))
    found, longer = [], []
    for start in range(len(vertices)):
        done: set[int] = set()
        beyond: dict[int, float] = {}
        heap = [(0.0, start)]
        while heap:
            path, at = heapq.heappop(heap)
            if at in done:
                continue
            done.add(at)
            for other, size in beside[at]:
                if other in done:
                    continue
                if path + size <= reach:
                    heapq.heappush(heap, (path + size, other))
                else:
                    beyond[other] = min(path + size, beyond.get(other, math.inf))
        found.append(done)
        longer.append(min((path for other, path in beyond.items() if other not in done), default=math.inf))
    return found, np.array(longer)


def smallest_height(vertices: np.ndarray, triangles: np.ndarray) -> float:
    """Smallest height of a triangle [m], inf without triangles."""
    corners = vertices[triangles]
    sides = [np.linalg.norm(corners[:, k] - corners[:, k - 1], axis=-1) for k in range(3)]
    twice = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    return float(np.min(twice / np.max(sides, axis=0), initial=math.inf))


def tree_order(centers: np.ndarray, leaves_per_root: int) -> np.ndarray:
    """Elements ordered so that aligned blocks of 4, 16, ... are compact, padded with -1 to whole roots; int32.

    Source: a k-d tree with medians at powers of two.
    """
    ordered: list[int] = []
    stack = [np.arange(len(centers))]
    while stack:
        ids = stack.pop()
        if len(ids) <= 1:
            ordered += ids.tolist()
            continue
        axis = int(np.ptp(centers[ids], axis=0).argmax())
        ids = ids[np.argsort(centers[ids, axis], kind="stable")]
        half = 1 << (len(ids) - 1).bit_length() - 1
        stack += [ids[half:], ids[:half]]
    padded = np.full(-(-len(ordered) // leaves_per_root) * leaves_per_root, -1, np.int32)
    padded[: len(ordered)] = ordered
    return padded


def _touching(near: list[set[int]], of: list[list[int]], elements: np.ndarray) -> np.ndarray:
    """For each list of vertices the elements that have a vertex near one of them, padded with -1."""
    owners: dict[int, set[int]] = defaultdict(set)
    for index, corners in enumerate(elements.tolist()):
        for corner in corners:
            owners[corner].add(index)
    found = [sorted(set().union(*(owners[v] for c in corners for v in near[c]))) for corners in of]
    table = np.full((len(found), max(map(len, found), default=0)), -1, np.int32)
    for row, ids in zip(table, found, strict=True):
        row[: len(ids)] = ids
    return table


def _pieces(edges: np.ndarray, num_vertices: int) -> np.ndarray:
    """A number for each connected piece of the mesh, shape (num_vertices,)."""
    piece, count = np.full(num_vertices, -1), 0
    near: dict[int, list[int]] = defaultdict(list)
    for a, b in edges.tolist():
        near[a].append(b)
        near[b].append(a)
    for start in range(num_vertices):
        if piece[start] >= 0:
            continue
        stack = [start]
        piece[start] = count
        while stack:
            for other in near[stack.pop()]:
                if piece[other] < 0:
                    piece[other] = count
                    stack.append(other)
        count += 1
    return piece


__all__ = ["APART", "ContactElements", "Kind", "mesh_edges", "near_vertices", "smallest_height", "tree_order"]
