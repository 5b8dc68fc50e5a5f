"""Tetrahedral meshes: built from boxes and grid cells, read from files, and checked.

Everything here is numpy and runs before a simulation starts. A tet (a, b, c, d) has positive orientation if
(b - a) . ((c - a) x (d - a)) > 0.
"""

import contextlib
import dataclasses
import io
import itertools
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, POSITIVE
from rewax.physics.numerics.fields import (
    check_fields,
    check_range,
    checked,
    indices,
    instance,
    integer,
    items,
    mask,
    one_of,
    real,
    static,
)
from rewax.physics.tets.tetmesh_checks import EDGES, FACES, check_connections, check_shapes, signed_volumes

MIN_SHAPE = 1e-5
"""Minimum of 6 volume / (longest edge)^3 of a tet; flatter tets are rejected. The corner tet of a cube has 0.35."""
TABLE_CELL = 0.354428
"""Edge length of a cubic cell of the table in the task SoftJumper [m]."""
_TABLE_CORNER = (-1.160, 0.007, -1.221)


@dataclasses.dataclass(frozen=True, eq=False)
class TetMesh:
    """Vertices, and tets (tetrahedra) that connect them.

    Attributes:
      vertices: positions [m], float64 of shape (num_vertices, 3).
      tets: the four vertices of each tet, int32 of shape (num_tets, 4).
    """

    vertices: np.ndarray
    tets: np.ndarray

    @property
    def volumes(self) -> np.ndarray:
        """Volume of each tet [m^3], shape (num_tets,), negative where it is inverted."""
        return signed_volumes(self.vertices, self.tets)

    @property
    def volume(self) -> float:
        """Volume of the body [m^3]."""
        return float(self.volumes.sum())


_MESH = instance(TetMesh, "give a TetMesh, of tetmesh.box or load_tetmesh for example")
_POINT = real(FINITE, "give a position in metres", shape=(3,))
_COUNTS = "give the numbers of cells along x, y and z, each at least 1"

# --- Boxes and cells --------------------------------------------------------------------------------------------------


@checked(
    size=real(POSITIVE, "give three edges in metres", shape=(3,)),
    counts=items(integer(1, _COUNTS), _COUNTS, length=3),
    center=_POINT,
    tets_per_cell=one_of(5, 6),
)
def box(
    size: Sequence[float],
    counts: Sequence[int],
    *,
    center: Sequence[float] = (0.0, 0.0, 0.0),
    tets_per_cell: int = 6,
) -> TetMesh:
    """A box of equal cells, each divided into tets.

    Args:
      size: edge lengths along x, y, z [m], > 0.
      counts: number of cells along x, y, z, >= 1.
      center: middle of the box [m].
      tets_per_cell: 5 or 6, see ``cells``.

    Raises:
      ValueError: a size that is not positive, a count below 1, or another number of tets per cell.

    Example:
      >>> mesh = box((2.0, 1.0, 1.0), (4, 2, 2))
      >>> len(mesh.vertices), len(mesh.tets), mesh.volume
      (45, 96, 2.0)
    """
    counts = [int(n) for n in counts]
    lines = [c + s * (np.arange(n + 1) / n - 0.5) for c, s, n in zip(center, size, counts, strict=True)]
    return cells(np.ones(tuple(counts), bool), lines, tets_per_cell=tets_per_cell)


@checked(
    occupied=mask("give a mask of shape (nx, ny, nz)", ("nx", "ny", "nz")),
    spacing=static(POSITIVE, "give the edge of a cube in metres"),
    corner=_POINT,
    tets_per_cell=one_of(5, 6),
)
def voxels(
    occupied: np.ndarray,
    spacing: float,
    *,
    corner: Sequence[float] = (0.0, 0.0, 0.0),
    tets_per_cell: int = 6,
) -> TetMesh:
    """A body of equal cubes.

    Args:
      occupied: mask of the cubes of the body, bool of shape (nx, ny, nz).
      spacing: edge of a cube [m], > 0.
      corner: lower corner of the cube with index (0, 0, 0) [m].
      tets_per_cell: 5 or 6, see ``cells``.

    Raises:
      ValueError: no cube is occupied, a spacing that is not positive, or another number of tets per cell.
    """
    occupied = np.asarray(occupied, bool)
    lines = [c + spacing * np.arange(n + 1) for c, n in zip(corner, occupied.shape, strict=True)]
    return cells(occupied, lines, tets_per_cell=tets_per_cell)


_LINE = real(FINITE, "give increasing coordinates in metres", shape=("num_lines",))


@checked(
    occupied=mask("give a mask of shape (nx, ny, nz)", ("nx", "ny", "nz")),
    lines=items(_LINE, "give three arrays of coordinates in metres", length=3),
    tets_per_cell=one_of(5, 6),
)
def cells(occupied: np.ndarray, lines: Sequence[np.ndarray], *, tets_per_cell: int = 6) -> TetMesh:
    """Mesh the occupied cells of a rectilinear grid. Tets of neighbouring cells share whole faces.

    With six tets per cell (Kuhn), all six share the diagonal from the lowest to the highest corner, and all cells are
    divided alike. With five, one tet lies in the middle and four at alternate corners, and neighbouring cells are
    mirror images. Five are fewer tets, but of unequal size.

    Args:
      occupied: mask of the cells of the body, bool of shape (nx, ny, nz).
      lines: coordinates of the grid along x, y, z [m], increasing, lengths nx + 1, ny + 1, nz + 1.
      tets_per_cell: 5 or 6.

    Returns:
      The mesh; tets of one cell are consecutive.

    Raises:
      ValueError: no cell is occupied, lines have a wrong length or do not increase, or ``tets_per_cell`` is not 5 or 6.
    """
    occupied = np.asarray(occupied, bool)
    if not occupied.any():
        raise ValueError(f"occupied has shape {occupied.shape} and no cell: give a mask with at least one cell")
    lines = [np.asarray(line, np.float64) for line in lines]
    if [len(line) for line in lines] != [n + 1 for n in occupied.shape]:
        raise ValueError(
            f"lines have {[len(line) for line in lines]} coordinates for {occupied.shape} cells: give one more of each"
        )
    if not all(np.all(np.diff(line) > 0) for line in lines):
        raise ValueError("lines do not increase: sort the coordinates along each axis and remove duplicates")
    index = np.argwhere(occupied)
    corners = _kuhn_corners(index) if tets_per_cell == 6 else _alternating_corners(index)
    shape = tuple(len(line) for line in lines)
    nodes = np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), shape).reshape(-1, 4)
    used, tets = np.unique(nodes, return_inverse=True)
    where = np.unravel_index(used, shape)
    vertices = np.stack([line[i] for line, i in zip(lines, where, strict=True)], axis=-1)
    return orient(TetMesh(vertices, tets.reshape(-1, 4).astype(np.int32)))


def soft_jumper_table() -> TetMesh:
    """The table of the task SoftJumper: 204 vertices, 444 tets, 4.8975 m^3.

    A slab of 7 x 2 x 7 cubes of edge ``TABLE_CELL`` stands on four legs of 1 x 3 x 1 cubes; y is up. The slab is one
    layer of cells, each two cubes high and divided into six tets. The vertical edges on the slab's rim are then split
    in the middle. No vertex lies inside the slab.

    Source: Rewarped's extents, counts and volume. Its decomposition is not published.
    """
    h = TABLE_CELL
    occupied = np.zeros((7, 4, 7), bool)
    occupied[:, 3] = True
    for i, k in itertools.product((0, 6), (0, 6)):
        occupied[i, :3, k] = True
    across, up = h * np.arange(8), h * np.array([0, 1, 2, 3, 5])
    x, y, z = _TABLE_CORNER
    mesh = cells(occupied, (x + across, y + up, z + across))
    offset = np.round((mesh.vertices - _TABLE_CORNER) / h).astype(int)
    rim = np.any((offset[:, [0, 2]] == 0) | (offset[:, [0, 2]] == 7), axis=1)
    vertex_at = {tuple(o): v for v, o in enumerate(offset)}
    low = np.flatnonzero(rim & (offset[:, 1] == 3))
    return split_edges(mesh, np.asarray([(v, vertex_at[tuple(offset[v] + [0, 2, 0])]) for v in low]))


@checked(mesh=_MESH, edges=indices("give pairs of vertices, integers of shape (num_edges, 2)", ("num_edges", 2)))
def split_edges(mesh: TetMesh, edges: np.ndarray) -> TetMesh:
    """Split edges at their midpoints. Each tet with a split edge becomes two consecutive tets.

    Args:
      mesh: the mesh.
      edges: vertex indices, shape (num_edges, 2); at most one edge of each tet.

    Raises:
      ValueError: the mesh does not have an edge, or two edges belong to the same tet.
    """
    first = len(mesh.vertices)
    middle = {frozenset(map(int, edge)): first + i for i, edge in enumerate(np.asarray(edges))}
    unused, tets = set(middle), []
    for tet in mesh.tets:
        hits = [e for e in EDGES if frozenset(map(int, tet[e])) in middle]
        if len(hits) > 1:
            raise ValueError(f"edges has two edges of the tet {tet.tolist()}: call split_edges once for each")
        if not hits:
            tets.append(tet)
            continue
        pair = frozenset(map(int, tet[hits[0]]))
        unused.discard(pair)
        for end in hits[0]:
            half = tet.copy()
            half[end] = middle[pair]
            tets.append(half)
    if unused:
        raise ValueError(
            f"edges has {sorted(unused.pop())}, which is no edge of the mesh: give pairs of vertices of one tet"
        )
    vertices = np.concatenate([mesh.vertices, mesh.vertices[np.asarray(edges)].mean(axis=1)])
    return TetMesh(vertices, np.asarray(tets, np.int32))


@checked(mesh=_MESH)
def orient(mesh: TetMesh) -> TetMesh:
    """Swap two vertices of every inverted tet, so that all tets have positive orientation."""
    tets = np.array(mesh.tets)
    inverted = mesh.volumes < 0
    tets[inverted] = tets[inverted][:, [0, 2, 1, 3]]
    return TetMesh(mesh.vertices, tets)


@checked(mesh=_MESH)
def boundary_faces(mesh: TetMesh) -> np.ndarray:
    """Triangles of the surface, counterclockwise seen from outside, int32 of shape (num_faces, 3)."""
    faces = mesh.tets[:, FACES].reshape(-1, 3)
    _, inverse, counts = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    return faces[counts[inverse.reshape(-1)] == 1]


# --- Files ------------------------------------------------------------------------------------------------------------


@checked(
    path=instance((str, os.PathLike), "give the path of a mesh file"),
    scale=static(POSITIVE, "give metres per unit of length"),
)
def load_tetmesh(path: str | Path, *, scale: float = 1.0, fix_orientation: bool = False) -> TetMesh:
    """Read the tets of a mesh file (.msh, .vtk, .vtu, .mesh or another format of meshio) and check the mesh.

    Surface elements are ignored. Points that no tet uses are removed, such as points of the geometry.

    Args:
      path: the file.
      scale: metres per unit of length in the file.
      fix_orientation: swap two vertices of each inverted tet, for files with the opposite orientation.

    Raises:
      ImportError: meshio is missing.
      ValueError: the file cannot be read, has no tets of four vertices, or ``check_tetmesh`` finds a fault.
    """
    try:
        import meshio
    except ImportError:
        raise ImportError("mesh files are read by meshio, which is missing: pip install 'rewax[meshes]'") from None
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"path is {str(path)!r}, but there is no such file: give the path of a mesh file")
    try:
        # meshio prints the errors of all its readers, and exits the program if none can read the file.
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            content = meshio.read(path)
    except (Exception, SystemExit) as error:
        raise ValueError(
            f"path is {str(path)!r}, which meshio cannot read ({error}): save the mesh as .msh, .vtk or .vtu"
        ) from None
    kinds = sorted({block.type for block in content.cells})
    tets = [np.asarray(block.data) for block in content.cells if block.type == "tetra"]
    if not tets:
        raise ValueError(
            f"path is {str(path)!r}, which holds {', '.join(kinds) or 'nothing'} but no tets of four vertices: "
            "mesh the volume with first-order tetrahedra"
        )
    used, indices = np.unique(np.concatenate(tets), return_inverse=True)
    vertices = scale * np.asarray(content.points, np.float64)[used]
    mesh = TetMesh(vertices, indices.reshape(-1, 4).astype(np.int32))
    mesh = orient(mesh) if fix_orientation else mesh
    check_tetmesh(mesh)
    return mesh


# --- Checks -----------------------------------------------------------------------------------------------------------


_FIELDS = {
    "vertices": real(FINITE, "give positions in metres", shape=("num_vertices", 3)),
    "tets": indices("give integers of shape (num_tets, 4)", ("num_tets", 4)),
}


@checked(mesh=_MESH, min_shape=static(NOT_NEGATIVE, "give a ratio, 1e-5 for example"))
def check_tetmesh(mesh: TetMesh, *, min_shape: float = MIN_SHAPE) -> None:
    """Raise a ValueError if a mesh has a fault. The message names the fault, its location and the remedy.

    Faults are wrong shapes and indices, non-finite positions, degenerate (flat) and inverted tets, vertices that no tet
    uses, faces shared by more than two tets, and meshes that are not connected through common faces.

    Args:
      mesh: the mesh.
      min_shape: minimum of 6 volume / (longest edge)^3; a tet below it is degenerate.
    """
    check_fields(_FIELDS, vars(mesh))
    vertices, tets = np.asarray(mesh.vertices), np.asarray(mesh.tets)
    if len(tets) == 0:
        raise ValueError("tets is empty: give at least one tet")
    check_range("tets", tets, len(vertices))
    check_shapes(vertices, tets, min_shape)
    unused = np.setdiff1d(np.arange(len(vertices)), tets)
    if len(unused):
        raise ValueError(
            f"vertices has {len(unused)} that no tet uses (the first is {unused[0]}), which would have no mass: "
            "remove them and renumber tets"
        )
    check_connections(tets)


# --- Decompositions of a cell -----------------------------------------------------------------------------------------


def _kuhn_corners(index: np.ndarray) -> np.ndarray:
    """Lattice points of six tets per cell, shape (num_cells, 6, 4, 3).

    Each tet holds the corners on a path of one step along each axis, from the lowest to the highest corner.
    """
    paths = [np.cumsum([[0, 0, 0], *np.eye(3, dtype=int)[list(p)]], axis=0) for p in itertools.permutations(range(3))]
    return index[:, None, None] + np.asarray(paths)


def _alternating_corners(index: np.ndarray) -> np.ndarray:
    """Lattice points of five tets per cell, shape (num_cells, 5, 4, 3), mirrored in x in cells of odd index sum."""
    inner = [(0, 0, 0), (1, 1, 0), (1, 0, 1), (0, 1, 1)]
    outer = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)]
    at_corners = [[o, *(i for i in inner if np.abs(np.subtract(o, i)).sum() == 1)] for o in outer]
    even = np.asarray([inner, *at_corners])
    odd = even * [-1, 1, 1] + [1, 0, 0]
    is_odd = (index.sum(axis=1) % 2 == 1)[:, None, None, None]
    return index[:, None, None] + np.where(is_odd, odd, even)


__all__ = [
    "TetMesh",
    "boundary_faces",
    "box",
    "cells",
    "check_tetmesh",
    "load_tetmesh",
    "orient",
    "soft_jumper_table",
    "split_edges",
    "voxels",
]
