"""The mesh of a ball."""

import functools
import itertools

import numpy as np


@functools.cache
def ball() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a unit sphere: an icosahedron with each face split into four."""
    golden = 0.5 * (1.0 + 5.0**0.5)
    corners = [np.roll([0.0, a, b * golden], shift) for shift in range(3) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
    vertices = np.stack(corners) / np.hypot(1.0, golden)
    edge = np.linalg.norm(vertices[:, None] - vertices, axis=-1).round(6)
    near = edge == edge[edge > 0.0].min()
    triangles = []
    for i, j, k in itertools.combinations(range(len(vertices)), 3):
        if near[i, j] and near[j, k] and near[i, k]:
            a, b, c = vertices[[i, j, k]]
            if np.linalg.det(np.stack([a, b, c])) < 0.0:
                b, c = c, b
            ab, bc, ca = (m / np.linalg.norm(m) for m in (a + b, b + c, c + a))
            triangles += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    vertices, index = np.unique(np.round(np.reshape(triangles, (-1, 3)), 6), axis=0, return_inverse=True)
    return vertices.astype(np.float32), index.reshape(-1, 3).astype(np.uint32)


__all__ = ["ball"]
