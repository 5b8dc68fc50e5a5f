"""The force of a pair by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from self_contact_bodies import FLOOR, FORCE, law, two

from rewax.physics import thin


@pytest.mark.parametrize("depth", [0.002, 0.012])
def test_a_vertex_above_a_triangle_is_pushed_with_the_force_of_its_depth(x64, depth):
    """k c^2 / (2 o) up to c = o = h / 4, k (c - o / 2) beyond; the corners share it by barycentric coordinates."""
    height = 0.02 - depth
    points = np.asarray([*FLOOR, [0.06, height, 0.09], [0.0, 0.5, 0.3], [0.3, 0.5, 0.0]])
    force = FORCE(two(points, "cloth"), thin.initial_state(points))
    onset = 0.005
    expected = 50.0 * (depth**2 / (2 * onset) if depth < onset else depth - onset / 2)
    np.testing.assert_allclose(force[3], [0.0, expected, 0.0], atol=1e-12)
    np.testing.assert_allclose(force[:3, 1], -expected * np.array([0.5, 0.3, 0.2]), atol=1e-12)


def test_crossing_segments_push_each_other_at_their_middles_and_friction_is_coulombs(x64):
    points = np.asarray([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.01, -0.1], [0.0, 0.01, 0.1]])
    scene = two(points, "rope")
    state = thin.initial_state(points)
    push = 50.0 * (0.01 - 0.0025)
    np.testing.assert_allclose(FORCE(scene, state)[:, 1], push * np.array([-0.5, -0.5, 0.5, 0.5]), atol=1e-12)
    for speed, drag in ((0.1, 0.05 * 0.1), (100.0, 0.4 * push)):
        sliding = state.replace(v=state.v.at[2:, 0].set(speed))
        np.testing.assert_allclose(FORCE(scene, sliding)[2:, 0].sum(), -drag, rtol=1e-9)


@pytest.mark.parametrize(("friction", "slope"), [(0.0, 0.0), (0.4, -0.05)])
def test_without_friction_nothing_holds_a_pair_that_does_not_slide(x64, central_difference, friction, slope):
    points = np.asarray([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.01, -0.1], [0.0, 0.01, 0.1]])
    scene, state = two(points, "rope"), thin.initial_state(points)
    scene = scene.replace(self_contact=law(friction=friction, max_speed=0.1))

    @jax.jit
    def drag(speed):
        return thin.self_contact_force(scene, state.replace(v=state.v.at[2:, 0].set(speed)))[2:, 0].sum()

    still = jnp.asarray(0.0)
    found = jax.jvp(drag, (still,), (1.0,))[1], jax.grad(drag)(still), central_difference(drag, still, 1.0)
    np.testing.assert_allclose(found, slope, rtol=1e-9)
