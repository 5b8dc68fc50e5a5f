"""The rest shape: of a mesh, of a pattern."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from thin_bodies import CLOTH, SHEET, cloth_scene

from rewax.physics import thin


def test_a_pattern_is_the_rest_shape_of_a_curved_start(x64):
    """A sheet rolled on a cylinder with a flat pattern wants to unroll; without the pattern it is at rest."""
    flat = np.asarray(SHEET.vertices)
    rolled = np.stack([0.2 * np.sin(flat[:, 0] / 0.2), 0.2 * np.cos(flat[:, 0] / 0.2), flat[:, 2]], axis=-1)
    own = thin.ThinMesh(vertices=rolled, triangles=SHEET.triangles)
    assert abs(thin.elastic_energy(cloth_scene(own), thin.initial_state(rolled))) < 1e-12
    cut = thin.ThinMesh(vertices=rolled, triangles=SHEET.triangles, pattern=flat[:, [0, 2]])
    cloth = thin.isotropic_cloth(**CLOTH).replace(warp=1e-9, weft=1e-9, coupling=0.0, shear=1e-9)
    scene = thin.make_scene(mesh=cut, dt=1e-4, cloth=cloth, bending_law=thin.BendingLaw.HINGES)
    energy = thin.elastic_energy(scene, thin.initial_state(rolled))
    # Three of four columns have hinges in their middle; the chords are 0.5 % shorter than the arcs.
    expected = 0.5 * float(cloth.bending) / 0.2**2 * 0.12 * 3 / 4
    np.testing.assert_allclose(energy, expected, rtol=0.02)


def test_the_length_of_the_warp_is_irrelevant(x64):
    topology = cloth_scene().topology
    along_z, short = (thin.rest_shape(topology, SHEET.vertices, warp=(0.0, 0.0, size)) for size in (1.0, 1e-4))
    np.testing.assert_allclose(short.inverse_edges, along_z.inverse_edges, atol=1e-12)
    assert np.abs(along_z.inverse_edges - cloth_scene().rest.inverse_edges).max() > 1.0


def test_the_rest_shape_of_a_mesh_is_that_of_the_scene(x64):
    scene = cloth_scene()
    again = thin.rest_shape(scene.topology, jnp.asarray(SHEET.vertices))
    for a, b in zip(jax.tree.leaves(scene.rest), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("law", thin.BendingLaw)
def test_a_pillow_of_two_sheets_on_each_other_is_at_rest_and_opens_to_both_sides(x64, law):
    """Its seams have a rest angle of 180 degrees, where the angle of a hinge jumps."""
    corners = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.0, 0.2], [0.0, 0.0, 0.2], *[[0.15, 0.0, 0.1]] * 2])
    triangles = [t for a in range(4) for t in ((a, (a + 1) % 4, 4), ((a + 1) % 4, a, 5))]
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    mesh = thin.ThinMesh(vertices=corners @ turn, triangles=np.asarray(triangles, np.int32))
    scene = cloth_scene(mesh, bending_law=law)
    np.testing.assert_allclose(np.sort(np.abs(scene.rest.angle))[-4:], np.pi)
    assert abs(thin.elastic_energy(scene, thin.initial_state(mesh.vertices))) < 1e-25
    energies = []
    for height in (1e-3, -1e-3):
        lifted = corners + np.array([0.0, height, 0.0]) * np.array([0, 0, 0, 0, 1, -1])[:, None]
        state = thin.initial_state(lifted @ turn)
        energies.append(float(thin.elastic_energy(scene, state)))
        assert jnp.abs(thin.internal_force(scene, state)).max() < 5e-3
    np.testing.assert_allclose(energies[0], energies[1], rtol=1e-6)
    assert 0.0 < energies[0] < 1e-5
