"""Whether cloth or ropes have crossed: exact tests of all pairs in NumPy and double precision, independent of rewax."""

import numpy as np


def edges_of(triangles: np.ndarray) -> np.ndarray:
    """The edges of triangles, each once, shape (num_edges, 2)."""
    return np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)


class ClothReferee:
    """Counts edges that pass through triangles with which they share no vertex."""

    def __init__(self, triangles: np.ndarray) -> None:
        self.edges, self.triangles = edges_of(triangles), triangles
        self.apart = ~(self.edges[:, None, :, None] == triangles[None, :, None, :]).any(axis=(2, 3))

    def crossings(self, x: np.ndarray) -> int:
        """Number of crossings at positions x, shape (num_vertices, 3)."""
        x = np.asarray(x, np.float64)
        ends, corners = x[self.edges], x[self.triangles]
        (low, high), (lower, upper) = ((each.min(axis=1).T, each.max(axis=1).T) for each in (ends, corners))
        near = self.apart.copy()
        for k in range(3):
            near &= (low[k][:, None] <= upper[k]) & (lower[k] <= high[k][:, None])
        i, j = np.nonzero(near)
        (p, q), (a, b, c) = ends[i].swapaxes(0, 1), corners[j].swapaxes(0, 1)
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
        near = np.all((lower[0] <= upper[1]) & (lower[1] <= upper[0]), axis=1)
        start, end = start[:, near], end[:, near]
        values = [_volume(*((1.0 - t) * start + t * end)) for t in TIMES]
        # Where all Bernstein coefficients of the cubic have one sign, it has no root.
        bernstein = np.linalg.solve(_BERNSTEIN, np.stack(values))
        turns = np.flatnonzero((bernstein.min(axis=0) <= 0.0) & (bernstein.max(axis=0) >= 0.0))
        return sum(self._meet(start[:, k], end[:, k], bernstein[:, k]) for k in turns)

    def _meet(self, start: np.ndarray, end: np.ndarray, bernstein: np.ndarray) -> bool:
        for root in np.polynomial.Polynomial(_POWERS @ bernstein).roots():
            if abs(root.imag) < 1e-9 and 0.0 <= root.real <= 1.0:
                a, b, c, d = (1.0 - root.real) * start + root.real * end
                s, t = np.linalg.lstsq(np.stack([b - a, c - d], axis=1), c - a, rcond=None)[0]
                if 0.0 <= s <= 1.0 and 0.0 <= t <= 1.0:
                    return True
        return False


TIMES = np.array([0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0])
_BERNSTEIN = np.stack([(1.0 - TIMES) ** 3, 3 * TIMES * (1 - TIMES) ** 2, 3 * TIMES**2 * (1 - TIMES), TIMES**3], axis=1)
_POWERS = np.array([[1.0, 0.0, 0.0, 0.0], [-3.0, 3.0, 0.0, 0.0], [3.0, -6.0, 3.0, 0.0], [-1.0, 3.0, -3.0, 1.0]])


def _volume(u: np.ndarray, v: np.ndarray, w: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.einsum("...a,...a->...", np.cross(v - u, w - u), z - u)


__all__ = ["ClothReferee", "RopeReferee", "edges_of"]
