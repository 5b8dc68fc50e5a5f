"""Faults of meshes are named; volumes carry the sign of the orientation."""

import numpy as np
import pytest

from rewax.physics.tets import tetmesh
from rewax.physics.tets.tetmesh import TetMesh, check_tetmesh
from rewax.physics.tets.tetmesh_checks import EDGES, FACES, signed_volumes

UNIT = tetmesh.box((1.0, 1.0, 1.0), (1, 1, 1), tets_per_cell=5)


def changed(vertices=None, tets=None):
    return TetMesh(UNIT.vertices if vertices is None else vertices, UNIT.tets if tets is None else tets)


def with_rows(array, index, row):
    array = array.copy()
    array[index] = row
    return array


FAR = TetMesh(np.concatenate([UNIT.vertices, UNIT.vertices + 5]), np.concatenate([UNIT.tets, UNIT.tets + 8]))
"""Two cubes apart."""
HINGE = tetmesh.voxels(np.array([[[1], [0]], [[0], [1]]], bool), 1.0)
"""Two cubes that share an edge only."""


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (changed(vertices=UNIT.vertices[:, :2]), r"vertices has shape \(8, 2\): give an array of shape \(num_vertices, 3\)"),
        (changed(tets=UNIT.tets[:, :3]), r"tets is an array of int32 of shape \(5, 3\): give integers"),
        (changed(tets=UNIT.tets.astype(float)), r"tets is an array of float64 of shape \(5, 4\): give integers"),
        (changed(tets=UNIT.tets[:0]), "tets is empty: give at least one tet"),
        (changed(tets=UNIT.tets + 1), "tets has indices from 1 to 8, but there are 8 vertices: give indices from 0 to 7"),
        (changed(vertices=with_rows(UNIT.vertices, 3, np.nan)), r"vertices\[3, 0\] is nan, but must be finite: give positions"),
        (changed(tets=with_rows(UNIT.tets, 2, UNIT.tets[2][[1, 0, 2, 3]])), r"tets has 1 of 5 inverted \(tet 2 .*: swap two"),
        (changed(tets=with_rows(UNIT.tets, 1, UNIT.tets[1][[0, 1, 2, 2]])), r"tets has 1 degenerate ones \(tet 1 .* remesh, or"),
        (changed(vertices=UNIT.vertices * [1, 1, 1e-6]), "tets has 5 degenerate ones"),
        (changed(vertices=np.concatenate([UNIT.vertices, [[9.0, 9, 9]]])), r"vertices has 1 that no tet uses \(the first is 8\)"),
        (changed(tets=np.concatenate([UNIT.tets, UNIT.tets[:1]])), "tets has 3 around the face .* remove overlaps and duplicates"),
        (FAR, "tets form 2 parts without a common face, of 5, 5 tets: merge coincident vertices, or simulate"),
        (HINGE, "tets form 2 parts without a common face, of 6, 6 tets"),
    ],
)  # fmt: skip
def test_faults_are_named(mesh, message):
    with pytest.raises(ValueError, match=message):
        check_tetmesh(mesh)


def test_volumes_have_the_sign_of_the_orientation_and_faces_point_outwards():
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(signed_volumes(corner, np.array([[0, 1, 2, 3], [1, 0, 2, 3]])), [1 / 6, -1 / 6])
    for opposite, (a, b, c) in enumerate(FACES):
        normal = np.cross(corner[b] - corner[a], corner[c] - corner[a])
        assert normal @ (corner[a] - corner[opposite]) > 0
    assert len({frozenset(edge) for edge in EDGES.tolist()}) == 6
