"""Faults of tetrahedral meshes: flat and inverted tets, crowded faces, bodies in several parts."""

import itertools

import numpy as np

FACES = np.asarray([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
"""Vertices of the face opposite each vertex, counterclockwise seen from outside."""
EDGES = np.asarray(list(itertools.combinations(range(4), 2)))
"""Pairs of vertices of a tet."""


def signed_volumes(vertices: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Volume of each tet [m^3], shape (num_tets,), negative where it is inverted."""
    a, b, c, d = np.moveaxis(np.asarray(vertices, np.float64)[tets], 1, 0)
    return np.einsum("ti,ti->t", b - a, np.cross(c - a, d - a)) / 6.0


def check_shapes(vertices: np.ndarray, tets: np.ndarray, min_shape: float) -> None:
    """Raises ValueError for flat and for inverted tets; ``min_shape`` as for ``tetmesh.check_tetmesh``."""
    volumes = signed_volumes(vertices, tets)
    ends = vertices[tets[:, EDGES]]
    longest = np.sqrt(np.sum((ends[:, :, 0] - ends[:, :, 1]) ** 2, axis=-1)).max(axis=1)
    flat = np.flatnonzero(np.abs(6 * volumes) <= min_shape * longest**3)
    if len(flat):
        t = int(flat[0])
        raise ValueError(
            f"tets has {len(flat)} degenerate ones (tet {t} with vertices {tets[t].tolist()} has volume "
            f"{volumes[t]:.3g} m^3 for edges of up to {longest[t]:.3g} m): remesh, or remove them"
        )
    inverted = np.flatnonzero(volumes < 0)
    if len(inverted):
        t = int(inverted[0])
        raise ValueError(
            f"tets has {len(inverted)} of {len(tets)} inverted (tet {t} with vertices {tets[t].tolist()} has volume "
            f"{volumes[t]:.3g} m^3): swap two vertices of each, as tetmesh.orient does"
        )


def check_connections(tets: np.ndarray) -> None:
    """Raises ValueError for faces of more than two tets, and for bodies in several parts."""
    faces = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    _, face, counts = np.unique(faces, axis=0, return_inverse=True, return_counts=True)
    face = face.reshape(-1, 4)
    if counts.max() > 2:
        crowded = faces[int(np.flatnonzero(face.reshape(-1) == counts.argmax())[0])]
        raise ValueError(
            f"tets has {counts.max()} around the face {crowded.tolist()}, where at most two can meet: remove overlaps "
            "and duplicates"
        )
    part = np.arange(len(tets))
    while True:
        lowest = np.full(len(counts), len(tets))
        np.minimum.at(lowest, face, part[:, None])
        new = lowest[face].min(axis=1)
        new = new[new]  # pointer jumping: two steps at once
        if np.array_equal(new, part):
            break
        part = new
    parts, sizes = np.unique(part, return_counts=True)
    if len(parts) > 1:
        raise ValueError(
            f"tets form {len(parts)} parts without a common face, of {', '.join(map(str, sizes[:5]))}"
            f"{', ...' if len(parts) > 5 else ''} tets: merge coincident vertices, or simulate each part as a mesh"
        )


__all__ = ["EDGES", "FACES", "check_connections", "check_shapes", "signed_volumes"]
