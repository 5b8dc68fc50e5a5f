"""The search finds all pairs that touch: forces sum to zero and equal those of a wide search, and those in JAX."""

import jax
import jax.numpy as jnp
import numpy as np
from self_contact_bodies import FORCE, folded

from rewax.lowering import portable
from rewax.physics import thin
from rewax.status import Status


def test_forces_and_torques_without_friction_sum_to_zero_and_equal_those_of_all_pairs(x64):
    scene, state = folded()
    force = FORCE(scene, state)
    scale = float(jnp.abs(force).max())
    assert scale > 0.05 and thin.check_status(scene, state) & Status.FULL_PAIRS == 0
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-12 * scale)
    slippery = scene.replace(self_contact=scene.self_contact.replace(friction=jnp.asarray(0.0)))
    turning = np.cross(state.x, FORCE(slippery, state)).sum(axis=0)
    np.testing.assert_allclose(turning, 0.0, atol=1e-12 * scale)
    # Friction acts at both closest points: its torque is at most the distance times its force.
    rubbing = np.abs(force - FORCE(slippery, state)).sum()
    assert 0.0 < np.linalg.norm(np.cross(state.x, force).sum(axis=0)) < 0.015 * rubbing
    with portable():
        in_jax = jax.jit(lambda scene, state: thin.self_contact_force(scene, state))(scene, state)
    np.testing.assert_allclose(in_jax, force, atol=1e-11 * scale)
    wide = scene.replace(self_contact=scene.self_contact.replace(max_speed=100.0, pairs_per_element=400))
    np.testing.assert_allclose(FORCE(wide, state), force, atol=1e-12 * scale)
