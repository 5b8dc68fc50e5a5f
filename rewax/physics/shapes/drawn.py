"""Drawings of shapes in their own frames, with the keys that ``rewax.viz.shapes`` lists."""

from typing import Any

import numpy as np

Drawing = dict[str, Any]
"""One rigid shape of a picture."""
ORIGIN, STRAIGHT = np.zeros(3), np.eye(3)
UPRIGHT = np.array([0.0, 1.0, 0.0])
"""Direction of the axis of shapes that have one."""


def mesh(surface: tuple[np.ndarray, np.ndarray] | None) -> list[Drawing]:
    """Drawing of vertices [m], shape (num_vertices, 3), and triangles, shape (num_triangles, 3); none for None."""
    if surface is None:
        return []
    vertices, triangles = surface
    return [{"kind": "mesh", "center": ORIGIN, "vertices": vertices, "triangles": triangles, "rotation": STRAIGHT}]


__all__ = ["ORIGIN", "STRAIGHT", "UPRIGHT", "Drawing", "mesh"]
