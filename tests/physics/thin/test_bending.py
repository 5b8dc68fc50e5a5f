"""Bending of cloth: derivatives at the smooth bar, the bound of its stiffness, sizes in single precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from thin_bodies import CLOTH, SHEET, cloth_scene, hessian, run, shaken

from rewax.physics import thin
from rewax.physics.thin.bending import bending_stiffness
from rewax.physics.thin.plate import plate_rest


@pytest.mark.parametrize("law", thin.BendingLaw)
def test_reverse_is_forward_is_finite_difference_without_contact(x64, agree_along, law):
    """With respect to start, materials and rest shape, to 1e-6."""
    scene = cloth_scene(damping=1e-3, bending_law=law)
    scene = scene.replace(cloth=scene.cloth.replace(bending=0.1))

    def far(cloth, state, vertices):
        new = scene.replace(cloth=cloth, rest=thin.rest_shape(scene.topology, vertices))
        return jnp.sum(jnp.cos(jnp.arange(60.0)).reshape(20, 3) * run(new, state, 10).x)

    args = (scene.cloth, shaken(SHEET, size=0.01), jnp.asarray(SHEET.vertices))
    rng = np.random.default_rng(2)
    noise = jax.tree.map(lambda a: (0.1 + 0.5 * jnp.abs(a)) * rng.standard_normal(jnp.shape(a)), args)
    zero = jax.tree.map(jnp.zeros_like, args)
    directions = {
        name: (*zero[:k], noise[k], *zero[k + 1 :]) for k, name in enumerate(("materials", "start", "rest shape"))
    }
    agree_along(far, args, directions, step=1e-5, exact=1e-9, bar=1e-6, least=1e-8, fourth=True)


@pytest.mark.parametrize("law", thin.BendingLaw)
def test_the_stiffness_of_bending_is_bounded_from_above_and_not_by_far(x64, law):
    scene = cloth_scene(bending_law=law)
    soft = scene.cloth.replace(warp=1e-12, weft=1e-12, coupling=0.0, shear=1e-12)
    H = np.asarray(hessian(scene.replace(cloth=soft), SHEET.vertices))
    bound = np.repeat(np.sqrt(bending_stiffness(scene)), 3)
    largest = np.linalg.eigvalsh(H / np.outer(bound, bound))[-1]
    assert 0.3 < largest < 1.0, largest


def test_sizes_in_single_precision_are_near_those_in_double(x64):
    scene = cloth_scene()
    edges = scene.rest.inverse_edges
    wide, narrow = (plate_rest(scene.topology, edges.astype(t)) for t in (jnp.float64, jnp.float32))
    assert narrow.weights.dtype == jnp.float32
    np.testing.assert_allclose(narrow.weights, wide.weights, atol=5e-3)
    np.testing.assert_allclose(narrow.compliance, wide.compliance, rtol=1e-4, atol=1e-4)


def test_flat_sheets_that_only_turn_have_no_bending(x64, rotations):
    """A creased rest shape keeps its crease: energy is zero there, and positive where it is pressed flat."""
    creased = np.array(SHEET.vertices)
    creased[:, 1] = 0.5 * np.abs(creased[:, 0] - 0.2)
    mesh = thin.ThinMesh(vertices=creased, triangles=SHEET.triangles)
    scene = thin.make_scene(mesh=mesh, dt=1e-5, cloth=thin.isotropic_cloth(**CLOTH))
    turned = creased @ rotations(1, 3)[0].T
    assert abs(thin.elastic_energy(scene, thin.initial_state(turned))) < 1e-18
    assert thin.elastic_energy(scene, thin.initial_state(SHEET.vertices)) > 1e-4
