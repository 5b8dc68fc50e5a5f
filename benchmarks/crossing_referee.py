"""Whether cloth or ropes have crossed: exact tests of all pairs in NumPy and double precision, independent of rewax."""

import numpy as np


def edges_of(triangles: np.ndarray) -> np.ndarray:
    """The edges of triangles, each once, shape (num_edges, 2)."""
    return np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)


class ClothReferee:
    """Counts edges that pass through triangles with which they share no vertex."""

    def __init__(self, triangles: np.ndarray) -> None:
        edges = edges_of(triangles)
        i, j = (k.reshape(-1) for k in np.indices((len(edges), len(triangles))))
        apart = ~(edges[i][:, :, None] == triangles[j][:, None, :]).any(axis=(1, 2))
        self.edges, self.triangles = edges[i[apart]], triangles[j[apart]]

    def crossings(self, x: np.ndarray) -> int:
        """Number of crossings at positions x, shape (num_vertices, 3)."""
        x = np.asarray(x, np.float64)
        ends, corners = x[self.edges], x[self.triangles]
        near = np.all((ends.min(axis=1) <= corners.max(axis=1)) & (corners.min(axis=1) <= ends.max(axis=1)), axis=1)
        (p, q), (a, b, c) = ends[near].swapaxes(0, 1), corners[near].swapaxes(0, 1)
        around = np.stack([_volume(p, q, *pair) for pair in ((a, b), (b, c), (c, a))])
        through = (around > 0).all(axis=0) | (around < 0).all(axis=0)
        return int(np.sum(through & (_volume(a, b, c, p) * _volume(a, b, c, q) < 0)))


class RopeReferee:
    """Counts segments that pass through each other between two frames, each vertex moving on a straight line."""

    def __init__(self, num_segments: int) -> None:
        i, j = np.triu_indices(num_segments, 2)
        self.ends = np.stack([i, i + 1, j, j + 1])

    def crossings(self, before: np.ndarray, after: np.ndarray) -> int:
        """Number of pairs that cross on the way between positions of shape (num_vertices, 3).

        Two segments meet where their four ends lie in a plane, at a root of a cubic polynomial in time, and where the
        meeting point of the two lines lies in both segments.
        """
        start, end = (np.asarray(x, np.float64)[self.ends] for x in (before, after))
        low, high = np.minimum(start, end), np.maximum(start, end)
        lower = [np.minimum(low[k], low[k + 1]) for k in (0, 2)]
        upper = [np.maximum(high[k], high[k + 1]) for k in (0, 2)]
        near = np.flatnonzero(np.all((lower[0] <= upper[1]) & (lower[1] <= upper[0]), axis=1))
        return sum(self._meet(start[:, k], end[:, k]) for k in near)

    def _meet(self, start: np.ndarray, end: np.ndarray) -> bool:
        times = np.linspace(0.0, 1.0, 4)
        at = [(1.0 - t) * start + t * end for t in times]
        cubic = np.polynomial.Polynomial.fit(times, [_volume(*x) for x in at], 3, domain=[0.0, 1.0], window=[0.0, 1.0])
        for root in cubic.roots():
            if abs(root.imag) < 1e-9 and 0.0 <= root.real <= 1.0:
                a, b, c, d = (1.0 - root.real) * start + root.real * end
                s, t = np.linalg.lstsq(np.stack([b - a, c - d], axis=1), c - a, rcond=None)[0]
                if 0.0 <= s <= 1.0 and 0.0 <= t <= 1.0:
                    return True
        return False


def _volume(u: np.ndarray, v: np.ndarray, w: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.einsum("...a,...a->...", np.cross(v - u, w - u), z - u)


__all__ = ["ClothReferee", "RopeReferee", "edges_of"]
