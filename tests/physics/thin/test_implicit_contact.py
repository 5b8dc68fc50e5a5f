"""Contact in an implicit step beside that of an explicit one, and friction."""

import jax
import jax.numpy as jnp
import numpy as np
from implicit_cases import touched
from thin_bodies import SHEET

from rewax.physics import thin
from rewax.physics.numerics import components as cp
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
