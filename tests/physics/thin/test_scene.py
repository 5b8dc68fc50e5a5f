"""Scenes of cloth and ropes hold the size and mass of their mesh."""

import jax
import numpy as np
from thin_bodies import CLOTH, LINE, SHEET, cloth_scene, rope_scene

from rewax.physics import thin
from rewax.physics.thin.thinmesh import bends, hinges
from rewax.status import Status


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


def test_few_programs_make_a_scene():
    """Run operation by operation, its sizes and limits would be some hundred programs."""
    names = []
    jax.clear_caches()
    jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **__: names.append(name))
    try:
        cloth_scene()
    finally:
        jax.monitoring.clear_event_listeners()
    assert 3 <= sum("backend_compile" in name for name in names) < 40


def test_a_scene_of_a_traced_material_has_a_gradient_and_a_status(x64):
    def tip(youngs_modulus):
        cloth = thin.isotropic_cloth(**CLOTH | {"youngs_modulus": youngs_modulus})
        scene = thin.make_scene(mesh=SHEET, dt=2e-4, cloth=cloth, held=[0, 1])
        end = thin.step(scene, thin.initial_state(1.01 * SHEET.vertices), thin.static_poses(20, dtype=float))
        return end.x[-1, 0], thin.check_status(scene, end)

    both = jax.jit(jax.value_and_grad(tip, has_aux=True))
    (value, status), slope = both(1e5)
    assert status == 0 and both(1e9)[0][1] & Status.INVALID_PARAMETERS  # too stiff for dt
    difference = (both(1e5 + 10)[0][0] - both(1e5 - 10)[0][0]) / 20
    assert value > 0.39 and abs(slope) > 1e-12
    np.testing.assert_allclose(slope, difference, rtol=1e-5)
