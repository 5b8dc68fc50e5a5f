"""Meshes of cloth and ropes: sizes, inner edges, orientation."""

import dataclasses

import numpy as np
from thin_bodies import LINE, SHEET

from rewax.physics.thin.thinmesh import bends, check_thinmesh, hinges


def test_triangles_of_a_sheet_look_up_and_cover_it():
    corners = SHEET.vertices[SHEET.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normal[:, 1] > 0).all()
    np.testing.assert_allclose(0.5 * normal[:, 1].sum(), 0.4 * 0.3)
    check_thinmesh(SHEET)


def test_a_hinge_has_its_opposite_vertices_left_and_right():
    triangles = np.asarray([[0, 1, 2], [1, 0, 3]])
    np.testing.assert_array_equal(hinges(triangles), [[0, 1, 2, 3]])
    # Edges inside: one diagonal per cell, and the lines between cells.
    assert len(hinges(SHEET.triangles)) == 4 * 3 + 3 * 3 + 4 * 2


def test_bends_are_the_inner_vertices_of_ropes_not_their_forks():
    np.testing.assert_array_equal(bends(LINE.segments)[:, 1], np.arange(1, 8))
    assert len(bends(np.asarray([[0, 1], [1, 2], [1, 3]]))) == 0
    np.testing.assert_array_equal(bends(np.asarray([[0, 1], [1, 2], [2, 0]]))[:, 1], [0, 1, 2])  # a closed loop


def test_a_rope_may_have_a_pattern():
    check_thinmesh(dataclasses.replace(LINE, pattern=np.zeros((len(LINE.vertices), 2))))
