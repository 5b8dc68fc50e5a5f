"""Meshes: counts, volumes, conformity; files; messages about bad arguments."""

import sys

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from rewax.physics.tets import tetmesh
from rewax.physics.tets.tetmesh import boundary_faces, check_tetmesh


def surface(mesh):
    """Area of the boundary, and the volume that it encloses."""
    a, b, c = np.moveaxis(mesh.vertices[boundary_faces(mesh)], 1, 0)
    normals = np.cross(b - a, c - a) / 2
    return np.linalg.norm(normals, axis=1).sum(), np.einsum("ti,ti->", a, normals) / 3


def exposed(occupied) -> int:
    """Faces of cubes with nothing behind them."""
    padded = np.pad(occupied, 1).astype(int)
    return int(sum(np.abs(np.diff(padded, axis=axis)).sum() for axis in range(3)))


@pytest.mark.parametrize("tets_per_cell", [5, 6])
@hypothesis.given(occupied=st.integers(1, 2**12 - 1))
def test_any_assembly_of_cubes_is_conforming(tets_per_cell, occupied):
    """Volume and surface are those of the cubes: a face that two tets do not share whole would show in the surface."""
    cubes = np.array([occupied >> i & 1 for i in range(12)], bool).reshape(3, 2, 2)
    mesh = tetmesh.voxels(cubes, 0.5, corner=(1.0, -2.0, 3.0), tets_per_cell=tets_per_cell)
    assert len(mesh.tets) == tets_per_cell * cubes.sum()
    assert mesh.volumes.min() > 0 and len(np.unique(mesh.tets)) == len(mesh.vertices)
    area, enclosed = surface(mesh)
    assert mesh.volume == pytest.approx(0.125 * cubes.sum()) == pytest.approx(enclosed)
    assert area == pytest.approx(0.25 * exposed(cubes))
    lowest = np.argwhere(cubes).min(axis=0) * 0.5 + [1.0, -2.0, 3.0]
    np.testing.assert_allclose(mesh.vertices.min(axis=0), lowest)


def test_box():
    mesh = tetmesh.box((3.0, 1.0, 2.0), (3, 2, 4), center=(1.0, 2.0, 3.0))
    assert (len(mesh.vertices), len(mesh.tets)) == (4 * 3 * 5, 3 * 2 * 4 * 6)
    np.testing.assert_allclose(
        [mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)], [[-0.5, 1.5, 2.0], [2.5, 2.5, 4.0]]
    )
    np.testing.assert_allclose(surface(mesh), [22.0, 6.0])
    check_tetmesh(mesh)


def test_the_table_of_the_soft_jumper():
    mesh = tetmesh.soft_jumper_table()
    check_tetmesh(mesh)
    assert (len(mesh.vertices), len(mesh.tets)) == (204, 444)
    assert mesh.volume == pytest.approx(4.8975, abs=1e-4)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [-1.160, 0.007, -1.221], atol=1e-3)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [1.321, 1.779, 1.260], atol=1e-3)
    # Top and bottom of the slab, its rim, and three sides' worth more for each leg: 202 squares, and no gap inside.
    area, enclosed = surface(mesh)
    assert area == pytest.approx(202 * tetmesh.TABLE_CELL**2) and enclosed == pytest.approx(mesh.volume)
    inside = np.setdiff1d(np.arange(204), boundary_faces(mesh))
    assert len(inside) == 0
    # Every tet belongs to a cell beside that of the one before: two that share an action are neighbours.
    middles = mesh.vertices[mesh.tets].mean(axis=1).reshape(222, 2, 3)
    assert np.linalg.norm(middles[:, 0] - middles[:, 1], axis=1).max() < 1.5 * tetmesh.TABLE_CELL


def test_split_edges():
    mesh = tetmesh.box((1.0, 1.0, 1.0), (1, 1, 1), tets_per_cell=6)
    low, high = (int(np.flatnonzero(np.all(mesh.vertices == corner, axis=1))[0]) for corner in (-0.5, 0.5))
    split = tetmesh.split_edges(mesh, np.array([[high, low]]))  # the diagonal, which all six share
    check_tetmesh(split)
    assert len(split.tets) == 12 and split.volumes == pytest.approx(1 / 12)
    np.testing.assert_array_equal(split.vertices[-1], 0.0)
    with pytest.raises(ValueError, match=r"edges has \[0, 99\], which is no edge of the mesh"):
        tetmesh.split_edges(mesh, np.array([[0, 99]]))
    with pytest.raises(ValueError, match=r"edges has two edges of the tet .*: call split_edges once for each"):
        tetmesh.split_edges(mesh, mesh.tets[0][[[0, 1], [1, 2]]])


# --- Files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["beam.msh", "beam.vtk", "beam.vtu", "beam.mesh"])
def test_files_come_back_as_written(tmp_path, name):
    meshio = pytest.importorskip("meshio")
    mesh = tetmesh.box((2.0, 1.0, 1.0), (2, 1, 1))
    # As generators write it: a point of the geometry that no tet uses, and the surface.
    points = np.insert(mesh.vertices, 0, [[9.0, 9.0, 9.0]], axis=0)
    cells = [("triangle", boundary_faces(mesh) + 1), ("tetra", mesh.tets + 1)]
    meshio.write(tmp_path / name, meshio.Mesh(points, cells))
    loaded = tetmesh.load_tetmesh(tmp_path / name, scale=0.1)
    np.testing.assert_allclose(loaded.vertices, 0.1 * mesh.vertices, rtol=1e-12)
    np.testing.assert_array_equal(loaded.tets, mesh.tets)
    assert loaded.vertices.dtype == np.float64 and loaded.tets.dtype == np.int32


def test_files_with_the_other_orientation(tmp_path):
    meshio = pytest.importorskip("meshio")
    mesh = tetmesh.box((2.0, 1.0, 1.0), (2, 1, 1))
    path = tmp_path / "mirrored.vtk"
    meshio.write(path, meshio.Mesh(mesh.vertices * [-1, 1, 1], [("tetra", mesh.tets)]))
    with pytest.raises(ValueError, match="tets has 12 of 12 inverted"):
        tetmesh.load_tetmesh(path)
    assert tetmesh.load_tetmesh(path, fix_orientation=True).volume == pytest.approx(2.0)


def test_files_that_hold_no_tets(tmp_path):
    meshio = pytest.importorskip("meshio")
    mesh = tetmesh.box((1.0, 1.0, 1.0), (1, 1, 1))
    surface_only = tmp_path / "surface.vtk"
    meshio.write(surface_only, meshio.Mesh(mesh.vertices, [("triangle", boundary_faces(mesh))]))
    with pytest.raises(ValueError, match=r"surface.vtk', which holds triangle but no tets of four vertices: mesh the"):
        tetmesh.load_tetmesh(surface_only)
    garbage = tmp_path / "garbage.vtk"
    garbage.write_text("not a mesh")
    with pytest.raises(ValueError, match=r"garbage.vtk', which meshio cannot read .*: save the mesh as .msh"):
        tetmesh.load_tetmesh(garbage)
    with pytest.raises(ValueError, match=r"missing.msh', but there is no such file: give the path"):
        tetmesh.load_tetmesh(tmp_path / "missing.msh")


def test_without_meshio(monkeypatch):
    monkeypatch.setitem(sys.modules, "meshio", None)
    with pytest.raises(ImportError, match=r"meshio, which is missing: pip install 'rewax\[meshes\]'"):
        tetmesh.load_tetmesh("beam.msh")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: tetmesh.box((1.0, 0.0, 1.0), (1, 1, 1)), r"size\[1\] is 0\.0, but must be positive: give three edges"),
        (lambda: tetmesh.box((1.0, 1.0, 1.0), (1, 0, 1)), r"counts\[1\] is 0: give the numbers of cells"),
        (lambda: tetmesh.box((1.0, 1.0, 1.0), (1, 1, 1), tets_per_cell=7), "tets_per_cell is 7: give 5 or 6"),
        (lambda: tetmesh.voxels(np.ones((1, 1, 1)), 0.0), "spacing is 0.0, but must be positive"),
        (lambda: tetmesh.voxels(np.zeros((1, 2, 1)), 1.0), r"occupied has shape \(1, 2, 1\) and no cell: give"),
        (lambda: tetmesh.cells(np.ones((1, 1, 1)), [[0, 1]] * 2 + [[0, 1, 2]]), r"lines have \[2, 2, 3\] coordinates for"),
        (lambda: tetmesh.cells(np.ones((1, 1, 1)), [[0, 1]] * 2 + [[1, 0]]), "lines do not increase: sort"),
    ],
)  # fmt: skip
def test_impossible_bodies_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
