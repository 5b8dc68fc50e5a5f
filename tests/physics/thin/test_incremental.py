"""Slopes of the incremental potential beside the forces of the explicit step."""

import jax.numpy as jnp
import numpy as np
import pytest
from thin_bodies import KINDS, shaken

from rewax.physics import thin
from rewax.physics.numerics import components as cp
from rewax.physics.thin import incremental


@pytest.mark.parametrize("kind", ["StVK", "hinges", "neo-Hookean", "rope"])
def test_the_slope_is_minus_the_explicit_force_at_a_small_step(x64, kind):
    """Elastic forces at once; viscous ones of the velocity (x - before) / dt up to terms of second order."""
    scene, mesh = KINDS[kind](damping=0.01)
    state = shaken(mesh, size=0.005, speed=0.5)
    x, v = cp.split_vector(state.x), cp.split_vector(state.v)
    for size, bar in ((0.0, 1e-12), (1e-3, 1e-3)):
        before = incremental.strains_before(scene, cp.vector(lambda i, size=size: x[i] - size * scene.dt * v[i]))
        found = -jnp.stack(incremental.elastic_slope(scene, before, x), axis=-1)
        force = np.asarray(thin.internal_force(scene, state.replace(v=size * state.v)))
        np.testing.assert_allclose(found, force, atol=bar * np.abs(force).max())
