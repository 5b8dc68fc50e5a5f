"""Meshes and scenes of cloth and ropes: what they hold and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from thin_bodies import CLOTH, LINE, SHEET, cloth_scene, rope_scene

from rewax.physics import thin
from rewax.physics.contact.penalty import Ground
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


def test_a_pattern_is_the_rest_shape_of_a_curved_start(x64):
    """A sheet rolled on a cylinder with a flat pattern wants to unroll; without the pattern it is at rest."""
    flat = np.asarray(SHEET.vertices)
    rolled = np.stack([0.2 * np.sin(flat[:, 0] / 0.2), 0.2 * np.cos(flat[:, 0] / 0.2), flat[:, 2]], axis=-1)
    own = thin.ThinMesh(vertices=rolled, triangles=SHEET.triangles)
    assert abs(thin.elastic_energy(cloth_scene(own), thin.initial_state(rolled))) < 1e-12
    cut = thin.ThinMesh(vertices=rolled, triangles=SHEET.triangles, pattern=flat[:, [0, 2]])
    cloth = thin.isotropic_cloth(**CLOTH).replace(warp=1e-9, weft=1e-9, coupling=0.0, shear=1e-9)
    scene = thin.make_scene(mesh=cut, dt=1e-4, cloth=cloth)
    energy = thin.elastic_energy(scene, thin.initial_state(rolled))
    # Three of four columns have hinges in their middle; the chords are 0.5 % shorter than the arcs.
    expected = 0.5 * float(cloth.bending) / 0.2**2 * 0.12 * 3 / 4
    np.testing.assert_allclose(energy, expected, rtol=0.02)


def test_the_rest_shape_of_a_mesh_is_that_of_the_scene(x64):
    scene = cloth_scene()
    again = thin.rest_shape(scene.topology, jnp.asarray(SHEET.vertices))
    for a, b in zip(jax.tree.leaves(scene.rest), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)


MOBIUS = thin.ThinMesh(vertices=np.eye(4, 3), triangles=np.asarray([[0, 1, 2], [0, 1, 3]]))
REFUSED = [
    (lambda: cloth_scene(dt=1.0), "above the largest stable"),
    (lambda: cloth_scene(dt=0.0), "dt is 0.0"),
    (lambda: cloth_scene(held=[99]), "held has indices"),
    (lambda: cloth_scene(held=[1, 1]), "different indices"),
    (lambda: cloth_scene(drag=-1.0), "drag is -1.0"),
    (lambda: cloth_scene(ground=Ground(normal=(0, 1, 0))), "contact is None"),
    (lambda: cloth_scene(rope=thin.Rope(stretch=1.0, density=1.0)), "rope is given"),
    (lambda: thin.make_scene(mesh=SHEET, dt=1e-4), "cloth is None"),
    (lambda: rope_scene(stretch=-1.0), "rope.stretch is -1.0"),
    (lambda: rope_scene(bending=np.ones(3)), r"give a number or an array of shape \(7,\)"),
    (lambda: cloth_scene(cloth=thin.Cloth(warp=1.0, weft=1.0, coupling=1.0, shear=1.0, density=1.0)), "sqrt"),
    (
        lambda: cloth_scene(
            cloth=thin.Cloth(warp=9.0, weft=1.0, shear=1.0, density=1.0), law=thin.MembraneLaw.NEO_HOOKEAN
        ),
        "law is NEO_HOOKEAN",
    ),
    (lambda: cloth_scene(MOBIUS), "twice in the same direction"),
    (lambda: rope_scene(thin.rope(np.zeros((3, 3)))), "no length"),
    (lambda: cloth_scene(thin.ThinMesh(vertices=np.eye(4, 3), triangles=[[0, 1, 2]])), "without an element"),
    (lambda: cloth_scene(thin.ThinMesh(vertices=np.zeros((3, 3)), triangles=[[0, 1, 2]])), "flat or mirrored"),
    (lambda: thin.sheet(-1.0, 1.0, 2, 2), "width is -1.0"),
    (lambda: thin.isotropic_cloth(**CLOTH | {"poissons_ratio": 0.6}), "poissons_ratio is 0.6"),
]


@pytest.mark.parametrize(("build", "message"), REFUSED)
def test_illegal_scenes_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
