"""Scenes of cloth and ropes hold the size and mass of their mesh."""

import numpy as np
from thin_bodies import LINE, SHEET, cloth_scene, rope_scene

from rewax.physics.thin.thinmesh import bends, hinges


def test_a_sheet_has_its_area_mass_and_inner_edges():
    scene = cloth_scene()
    np.testing.assert_allclose(scene.rest.area.sum(), 0.12, rtol=1e-6)
    np.testing.assert_allclose(scene.mass.sum(), 0.12 * 300.0 * 5e-3, rtol=1e-6)
    assert len(hinges(SHEET.triangles)) == 4 * 3 + 3 * 3 + 4 * 2
    np.testing.assert_allclose(scene.rest.angle, 0.0)


def test_a_rope_has_its_length_mass_and_inner_vertices():
    scene = rope_scene()
    np.testing.assert_allclose(scene.rest.length.sum(), 1.0, rtol=1e-6)
    np.testing.assert_allclose(scene.mass.sum(), 0.1, rtol=1e-6)
    np.testing.assert_array_equal(bends(LINE.segments)[:, 1], np.arange(1, 8))
