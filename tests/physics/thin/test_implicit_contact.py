"""Contact in an implicit step beside that of an explicit one, and friction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from implicit_cases import touched
from thin_bodies import SHEET

from rewax.physics import thin
from rewax.physics.contact import Collider, PenaltyContact
from rewax.physics.numerics import Pose
from rewax.physics.numerics import components as cp
from rewax.physics.shapes import HeightField, SampledDistance
from rewax.physics.thin import implicit_contact


def test_bodies_at_rest_push_as_in_an_explicit_step(x64):
    scene, state, poses = touched()
    still = jax.tree.map(lambda a: a[0], poses)
    state = state.replace(v=jnp.zeros_like(state.v))
    x, v = cp.split_vector(state.x), cp.split_vector(state.v)
    total = 0.0
    for place in implicit_contact.surfaces(scene, (still, still)):
        touch = implicit_contact.touch(scene.contact, place, x, v, scene.dt)
        np.testing.assert_allclose(jnp.stack(touch.moved), jnp.stack(x), atol=1e-15)
        total -= jnp.stack(implicit_contact.touch_slope(scene.contact, place, touch, x, scene.dt), axis=-1)
    force = np.asarray(thin.contact_force(scene, state, still, still))
    assert np.abs(force).max() > 0.1
    np.testing.assert_allclose(total, force, atol=1e-12)
    assert len(force) == len(SHEET.vertices)


def test_friction_is_linear_below_coulombs_limit_and_constant_beyond(x64):
    one, zero = jnp.ones(3), jnp.zeros(3)
    sliding = implicit_contact.Sliding((zero, one, zero), 0.2 * one, 4.0 * one)
    u = (jnp.array([1e-4, 1e-3, 0.0]), jnp.array([5.0, 5.0, 5.0]), zero)
    found = implicit_contact.friction_slope(sliding, u, jnp.asarray(0.01))
    np.testing.assert_allclose(found[0], [4.0 * 1e-4 / 0.01, 0.2, 0.0], rtol=1e-12)
    np.testing.assert_allclose(found[1], 0.0, atol=1e-15)


@pytest.mark.parametrize(("limit", "stiffness"), [(0.0, 0.0), (0.2, 400.0)])
def test_without_friction_nothing_holds_what_has_not_slid(x64, central_difference, limit, stiffness):
    zero, one = jnp.zeros(1), jnp.ones(1)

    def drag(u):
        sliding = implicit_contact.Sliding((zero, one, zero), limit * one, 4.0 * one)
        return implicit_contact.friction_slope(sliding, (u, zero, zero), jnp.asarray(0.01))[0][0]

    assert jax.grad(drag)(zero)[0] == jax.jvp(drag, (zero,), (one,))[1] == stiffness
    np.testing.assert_allclose(central_difference(drag, zero, one), stiffness, rtol=1e-9)


NODES = 0.03 * (np.stack(np.meshgrid(*[np.arange(8.0)] * 3, indexing="ij"), axis=-1) - 3.5)
INEXACT = {
    "samples of a ball": SampledDistance(
        values=np.linalg.norm(NODES, axis=-1) - 0.05, origin=NODES[0, 0, 0], spacing=0.03
    ),
    "a height field": HeightField(
        heights=np.array([[0.0, 0.02, 0.0], [0.015, 0.0, 0.02], [0.0, 0.03, 0.01]]), origin=(-0.05, -0.05), spacing=0.08
    ),
}


@pytest.mark.parametrize("name", INEXACT)
def test_the_curvature_is_the_derivative_of_the_force_where_distances_are_not_exact(x64, name):
    """There the normal is not the gradient of the distance. An implicit step needs a symmetric derivative."""
    contact, x = PenaltyContact(stiffness=200.0), jnp.array([[0.01, 0.005, 0.004], [0.02, -0.002, 0.03]])
    end = Pose(jnp.zeros(3), jnp.eye(3))
    place = implicit_contact.Surface(Collider(shape=INEXACT[name], friction=0.0), (end, end), None, jnp.asarray(0.0))
    at = implicit_contact.touch(contact, place, cp.split_vector(x), cp.split_vector(jnp.zeros((2, 3))), 1e-3)
    assert np.all(np.asarray(at.distance) < -1e-3)

    def slope(flat):
        moved = cp.split_vector(flat.reshape(-1, 3))
        return jnp.stack(implicit_contact.touch_slope(contact, place, at, moved, 1e-3), axis=-1).reshape(-1)

    @jax.jit
    def both(x):
        curvature = implicit_contact.touch_curvature(contact, place, at, cp.split_vector(x), 1e-3, jnp.ones(2))

        def product(p):
            return jnp.stack(curvature(cp.split_vector(p.reshape(-1, 3))), axis=-1).reshape(-1)

        return jax.vmap(product)(jnp.eye(6)), jax.jacfwd(slope)(x.reshape(-1))

    matrix, expected = both(x)
    size = np.abs(expected).max()
    np.testing.assert_allclose(expected, expected.T, atol=1e-10 * size)
    np.testing.assert_allclose(matrix, expected, atol=1e-10 * size)
    assert size > 10.0
