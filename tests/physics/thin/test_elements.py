"""Forces of elements: minus the gradient of energy, objective, with the stiffness that the material says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from thin_bodies import KINDS, LINE, SHEET, rope_scene, shaken

from rewax.physics import thin
from rewax.physics.thin import elements, incremental

FORCE = jax.jit(thin.internal_force)


SLOPE = jax.jit(lambda scene, state: jax.grad(lambda x: thin.elastic_energy(scene, state.replace(x=x)))(state.x))


@pytest.mark.parametrize("kind", KINDS)
def test_forces_are_minus_the_gradient_of_energy_and_turn_with_the_body(x64, rotations, kind):
    scene, mesh = KINDS[kind]()
    state = shaken(mesh)
    force = FORCE(scene, state)
    scale = np.abs(force).max()
    assert scale > 10.0
    np.testing.assert_allclose(force, -SLOPE(scene, state), atol=1e-12 * scale)
    damped, _ = KINDS[kind](damping=1e-3)
    force, R = FORCE(damped, state), rotations(1, 1)[0]
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-11 * scale)
    np.testing.assert_allclose(np.cross(state.x, force).sum(axis=0), 0.0, atol=1e-11 * scale)
    spin = np.cross([1.0, -2.0, 0.5], state.x @ R.T)
    turned = state.replace(x=state.x @ R.T + 3.0, v=state.v @ R.T + spin + 5.0)
    np.testing.assert_allclose(FORCE(damped, turned), force @ R.T, atol=1e-10 * scale)
    assert np.abs(FORCE(scene, state) - force).max() > 1e-3 * scale  # damping acts


def test_warp_and_weft_pull_as_their_stiffness_says(x64):
    """Force over width is stiffness times strain, in uniaxial strain along either axis."""
    cloth = thin.Cloth(warp=600.0, weft=300.0, shear=40.0, bending=1e-3, density=1.0)
    scene = thin.make_scene(mesh=SHEET, dt=1e-4, cloth=cloth)
    e = 1e-6
    for axis, width, stiffness in ((0, 0.3, 600.0), (2, 0.4, 300.0)):
        x = np.array(SHEET.vertices)
        end = x[:, axis] > x[:, axis].max() - 1e-9
        x[:, axis] *= 1 + e
        force = FORCE(scene, thin.initial_state(x))[end].sum(axis=0)
        np.testing.assert_allclose(force[axis], -stiffness * e * width, rtol=1e-5)


def test_a_straight_rope_has_a_gradient_with_respect_to_bending_forces(x64):
    """The stiffness of a straight rope is not silently zero: bending gradients start at |kb| = 0."""
    scene = rope_scene(held=[0, 1])
    column = jax.jvp(lambda x: thin.internal_force(scene, thin.initial_state(x)), (jnp.asarray(LINE.vertices),),
                     (jnp.zeros((9, 3)).at[8, 1].set(1.0),))[1]  # fmt: skip
    np.testing.assert_allclose(column[8, 1], -0.1 / 0.125**3, rtol=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_rope_that_is_folded_back_onto_itself_has_finite_forces(x64, dtype):
    """For the explicit law (energy) and the implicit one (binormal), at random directions; near the fold both are exact."""
    a = np.random.default_rng(0).normal(size=(3, 50)).astype(dtype)

    def curvatures(x):
        corners = tuple(tuple(c) for c in x)
        return elements.half_square_curvature(corners), jnp.stack(incremental.curvature_binormal(corners))

    x = jnp.asarray(np.stack([0 * a, a, 0 * a]))
    first = jax.jacrev(lambda x: jax.tree.map(lambda c: c.sum(axis=-1), curvatures(x)))
    for values in (curvatures(x), first(x), jax.jacfwd(first)(x)):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(values))
    np.testing.assert_array_equal(first(x)[0], 0.0)
    open_by = 0.02
    hinge = jnp.array([[[0.0], [0.0], [0.0]], [[1.0], [0.0], [0.0]], [[1 - np.cos(open_by)], [np.sin(open_by)], [0.0]]])
    energy, binormal = curvatures(hinge.astype(dtype))
    tangent = 2.0 / np.tan(open_by / 2)
    np.testing.assert_allclose([2.0 * energy[0] / tangent, binormal[2, 0]], tangent, rtol=2e-3)
