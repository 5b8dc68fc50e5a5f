"""Self-contact in an implicit step beside that of an explicit one."""

import jax.numpy as jnp
import numpy as np
from implicit_cases import met

from rewax.physics import thin
from rewax.physics.numerics import components as cp
from rewax.physics.thin import implicit_pairs
from rewax.physics.thin.self_contact import close_pairs


def test_layers_at_rest_push_as_in_an_explicit_step_and_forces_sum_to_zero(x64):
    scene, state, _ = met()
    state = state.replace(v=jnp.zeros_like(state.v))
    x, v = cp.split_vector(state.x), cp.split_vector(state.v)
    meetings = implicit_pairs.meetings(scene, close_pairs(scene, x), x, v)
    found = -jnp.stack(implicit_pairs.pairs_slope(scene, meetings, x), axis=-1)
    force = np.asarray(thin.self_contact_force(scene, state))
    assert np.abs(force).max() > 0.01
    np.testing.assert_allclose(found, force, atol=1e-12)
    moved = cp.vector(lambda i: x[i] + 1e-4 * jnp.sin(5.0 * jnp.arange(len(state.x)) + i))
    sliding = jnp.stack(implicit_pairs.pairs_slope(scene, meetings, moved), axis=-1)
    np.testing.assert_allclose(jnp.sum(sliding, axis=0), 0.0, atol=1e-12)
    assert float(jnp.abs(sliding + found).max()) > 1e-3
