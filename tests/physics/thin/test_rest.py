"""The rest shape: of a mesh, of a pattern."""

import jax
import jax.numpy as jnp
import numpy as np
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


def test_the_rest_shape_of_a_mesh_is_that_of_the_scene(x64):
    scene = cloth_scene()
    again = thin.rest_shape(scene.topology, jnp.asarray(SHEET.vertices))
    for a, b in zip(jax.tree.leaves(scene.rest), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
