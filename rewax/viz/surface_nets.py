"""Surface nets (Gibson 1998): a closed mesh where numbers on a grid cross a level.

The player has the same method in ``player_surface.js``.
"""

import numpy as np

_AXES = np.eye(3, dtype=int)


def surface_nets(values: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surface around the nodes above a level.

    Each cell with nodes on both sides gets one vertex: the mean of the points where its edges cross the level. Each
    edge that crosses joins the vertices of its four cells by two triangles.

    Args:
      values: shape (nx, ny, nz); below the level on the two outermost layers of nodes, so that the surface is closed.
      level: value on the surface.

    Returns:
      Vertices in units of cells from node (0, 0, 0), shape (n, 3); outward normals of unit length, down the gradient,
      shape (n, 3); triangles, counter-clockwise seen from outside, shape (m, 3).
    """
    edges = [_crossings(values - level, axis) for axis in range(3)]
    cells = np.concatenate([_cells_around(values.shape, nodes, axis) for axis, (nodes, _, _) in enumerate(edges)])
    used, index, counts = np.unique(cells, return_inverse=True, return_counts=True)
    at = np.repeat(np.concatenate([points for _, points, _ in edges]), 4, axis=0)
    sums = [np.bincount(index.reshape(-1), weights=at[:, i], minlength=len(used)) for i in range(3)]
    vertices = np.stack(sums, axis=-1) / counts[:, None]
    quads = index.reshape(-1, 4)
    rising = np.concatenate([part for _, _, part in edges])
    quads = np.where(rising[:, None], quads[:, ::-1], quads)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return vertices, _normals(values, vertices), triangles


def _crossings(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges along an axis whose ends differ in sign: lower nodes, crossing points, whether the value rises along it."""
    count = values.shape[axis] - 1
    low, high = np.take(values, range(count), axis), np.take(values, range(1, count + 1), axis)
    nodes = np.argwhere((low > 0.0) != (high > 0.0))
    below, above = low[tuple(nodes.T)], high[tuple(nodes.T)]
    part = below / (below - above)
    return nodes, nodes + part[:, None] * _AXES[axis], above > below


def _cells_around(shape: tuple[int, ...], nodes: np.ndarray, axis: int) -> np.ndarray:
    """Flat indices of the four cells around each edge, counter-clockwise about its axis, shape (num_edges, 4)."""
    second, third = _AXES[(axis + 1) % 3], _AXES[(axis + 2) % 3]
    around = [nodes, nodes - second, nodes - second - third, nodes - third]
    return np.stack([np.ravel_multi_index(tuple(cell.T), shape) for cell in around], axis=-1)


def _normals(values: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Central differences at the corners of each vertex's cell, interpolated between them, turned outwards."""
    base = np.floor(vertices).astype(int)
    part = vertices - base
    gradient = np.zeros_like(vertices)
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, part, 1.0 - part), axis=1)
        node = base + corner
        for axis in range(3):
            ahead, behind = node + _AXES[axis], node - _AXES[axis]
            gradient[:, axis] += weight * (values[tuple(ahead.T)] - values[tuple(behind.T)])
    return -gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-300)


__all__ = ["surface_nets"]
