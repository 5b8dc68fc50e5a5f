"""Signed distances of triangle meshes on a grid, for contact with particles."""

import math
import os
from typing import Any

import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics.checks import FINITE, POSITIVE, shown
from rewax.physics.numerics.fields import check_fields, check_range, checked, indices, optional, real, static
from rewax.physics.shapes.mesh_distance import distance_on_grid, winding_on_grid
from rewax.physics.shapes.sampled import SampledDistance

MAX_VALUES = 2**27
"""Largest number of grid values that ``bake_mesh`` accepts: half a gigabyte in float32."""
_MESH = {
    "vertices": real(FINITE, "repair the mesh", shape=("num_vertices", 3)),
    "faces": indices("give integers of shape (num_faces, 3)", ("num_faces", 3)),
}


@checked(
    spacing=static(POSITIVE, "give the distance of grid nodes in metres"),
    margin=optional(static(POSITIVE, "give the extent of the grid beyond the mesh in metres")),
)
def bake_mesh(mesh: Any, spacing: float, *, margin: float | None = None) -> SampledDistance:
    """The signed distance of a closed triangle mesh at the nodes of a regular grid around it.

    Distances at the nodes are exact. A node is inside if its winding number, counted along lines parallel to x, y and
    z, is positive for at least two of the three. So parts of the mesh may overlap (distances are then those to the
    nearest face, also an internal one), and shells that point inwards are cavities.

    Args:
      mesh: path of a file that trimesh reads (STL, OBJ, PLY, ...), a ``trimesh.Trimesh``, or anything else with
        ``vertices`` [m], shape (num_vertices, 3), and ``faces``, indices of shape (num_faces, 3), counterclockwise
        seen from outside.
      spacing: distance of the grid's nodes [m]; it rounds off smaller edges and features.
      margin: extent of the grid beyond the mesh on all sides [m], by default two cells. Farther away distances are only
        estimated.

    Returns:
      The baked distance in the mesh's own frame, in JAX's default float type. 64^3 nodes of a mesh of 5000 faces take
      seconds; memory grows with the number of nodes.

    Raises:
      ValueError: a path without file; a mesh that is empty, open, inconsistently oriented, inside out or has faces
        without area; a spacing or margin that is not positive; too many nodes. The message names the remedy.
      ImportError: a path is given and trimesh is not installed.

    Gradient: none with respect to the mesh. ``SampledDistance.distance`` has one with respect to the values.

    Example:
      >>> shape = bake_mesh("bunny.stl", spacing=0.01)  # doctest: +SKIP
      >>> collider = Collider(shape=shape, friction=0.5)  # doctest: +SKIP
    """
    margin = 2.0 * spacing if margin is None else margin
    triangles = check_mesh(mesh)
    lower, upper = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    counts = np.ceil((upper - lower + 2.0 * margin) / spacing - 1e-9).astype(int) + 1
    if math.prod(int(n) for n in counts) > MAX_VALUES:
        raise ValueError(
            f"spacing is {spacing:g}, which makes a grid of {' x '.join(map(str, counts))} nodes for a mesh of "
            f"{' x '.join(f'{a:.3g}' for a in upper - lower)} m: give a larger spacing or a smaller margin"
        )
    origin = 0.5 * (lower + upper - (counts - 1) * spacing)
    axes = [origin[i] + spacing * np.arange(counts[i]) for i in range(3)]
    distance = distance_on_grid(triangles, axes)
    inside = sum((winding_on_grid(triangles, axes, axis) > 0).astype(np.int8) for axis in range(3)) >= 2
    values = np.where(inside, -distance, distance)
    return SampledDistance(
        values=jnp.asarray(values, float), origin=jnp.asarray(origin, float), spacing=jnp.asarray(spacing, float)
    )


def check_mesh(mesh: Any) -> np.ndarray:
    """The triangles of a mesh that bounds a volume [m], float64 of shape (num_faces, 3, 3).

    Args:
      mesh: as for ``bake_mesh``.

    Raises:
      ValueError, ImportError: as ``bake_mesh``.
    """
    if isinstance(mesh, (str, os.PathLike)):
        mesh = _load(os.fspath(mesh))
    if not (hasattr(mesh, "vertices") and hasattr(mesh, "faces")):
        raise ValueError(
            f"mesh is {shown(mesh)}: give a path or something with vertices and faces, such as trimesh.Trimesh"
        )
    check_fields(_MESH, {"vertices": mesh.vertices, "faces": mesh.faces}, "mesh.")
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if len(faces) == 0:
        raise ValueError("mesh has no faces: give a closed surface of triangles")
    check_range("mesh.faces", faces, len(vertices))
    # Formats such as STL repeat each vertex for every face.
    vertices, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    triangles = vertices[faces]
    _check_areas(triangles)
    _check_edges(faces, len(vertices))
    volume = signed_volume(triangles)
    if not volume > 0:
        raise ValueError(
            f"mesh is inside out (its signed volume is {volume:.3g} m^3): turn its faces round, e.g. with mesh.invert()"
        )
    return triangles


def signed_volume(triangles: np.ndarray) -> float:
    """Enclosed volume [m^3] of triangles, shape (num_faces, 3, 3): positive if counterclockwise seen from outside.

    Overlapping parts count several times.
    """
    a, b, c = np.moveaxis(triangles - triangles.mean(axis=(0, 1)), 1, 0)
    return float(np.einsum("fi,fi->", a, np.cross(b, c))) / 6.0


def _load(path: str) -> Any:
    try:
        import trimesh
    except ImportError as error:
        raise ImportError(
            f"reading the mesh {path!r} needs trimesh, which is not installed: pip install 'rewax[meshes]'"
        ) from error
    if not os.path.isfile(path):
        raise ValueError(f"mesh is {path!r}, but there is no such file: give the path of a mesh")
    return trimesh.load(path, force="mesh")


def _check_areas(triangles: np.ndarray) -> None:
    a, b, c = np.moveaxis(triangles, 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.sum((p - q) ** 2, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    (flat,) = np.nonzero(area <= 1e-12 * longest)
    if len(flat):
        raise ValueError(
            f"mesh has {len(flat)} degenerate faces without area (the first is face {flat[0]}): remove them, e.g. with "
            "mesh.update_faces(mesh.nondegenerate_faces()), and close the gaps that this leaves"
        )


def _check_edges(faces: np.ndarray, num_vertices: int) -> None:
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    edges, index = np.unique(np.minimum(start, end) * num_vertices + np.maximum(start, end), return_inverse=True)
    num_faces = np.bincount(index, minlength=len(edges))
    num_open = int(np.sum(num_faces % 2))
    if num_open:
        raise ValueError(
            f"mesh is not watertight: {num_open} of its {len(edges)} edges are open, so inside and outside are not "
            "defined; close it, e.g. with trimesh.repair.fill_holes(mesh) or in a modelling program"
        )
    turns = np.bincount(index, weights=np.where(start < end, 1.0, -1.0), minlength=len(edges))
    num_wrong = int(np.sum(turns != 0))
    if num_wrong:
        raise ValueError(
            f"mesh is not consistently oriented: the two faces at {num_wrong} of its {len(edges)} edges turn in "
            "opposite directions; orient them alike, e.g. with trimesh.repair.fix_normals(mesh)"
        )


__all__ = ["bake_mesh", "check_mesh", "signed_volume"]
