"""The force of a grasp is that of its law, and its holds follow the vertices at its rate."""

import jax.numpy as jnp
import numpy as np
import pytest
from thin_bodies import SHEET, cloth_scene, shaken

from rewax.physics import thin
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.pose import Pose
from rewax.physics.thin import grasp_forces
from rewax.physics.thin.grasps import Hold

SOME = (0, 3, 7, 8)


def moving_hand(seed=0):
    """Poses of two bodies at both ends of a substep of 2e-4 s; the second turns and moves."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    skew = 1e-3 * rng.standard_normal((3, 3))
    places = 0.1 * rng.standard_normal((2, 3))
    before = Pose(jnp.asarray(places), jnp.stack([jnp.eye(3), turn]))
    shift, spin = 1e-4 * rng.standard_normal((2, 3)), np.stack([np.zeros((3, 3)), (skew - skew.T) @ turn])
    return before, Pose(before.position + shift, before.rotation + spin)


@pytest.mark.parametrize("vertices", [None, SOME])
def test_the_force_is_that_of_the_law(x64, vertices):
    grasp = thin.Grasp(radius=0.3, stiffness=70.0, damping=0.3, body=1, vertices=vertices)
    scene, state = cloth_scene(grasps=(grasp,)), shaken(SHEET)
    before, after = moving_hand()
    at = np.arange(len(SHEET.vertices)) if vertices is None else np.array(SOME)
    rng = np.random.default_rng(1)
    hold = Hold(point=jnp.asarray(rng.standard_normal((len(at), 3))), share=jnp.asarray(rng.uniform(size=len(at))))
    x, v = cp.split_vector(state.x), cp.split_vector(state.v)
    surface = grasp_forces.body_velocities(scene, x, (before, after))
    (pull,) = grasp_forces.pulls(scene, grasp_forces.split_holds((hold,)), x, v, before, surface, jnp.array([0.7]))
    p, R = np.asarray(before.position[1]), np.asarray(before.rotation[1])
    local = (np.asarray(state.x)[at] - p) @ R
    moved = local @ np.asarray(after.rotation[1]).T + np.asarray(after.position[1])
    speed = (moved - np.asarray(state.x)[at]) / scene.dt
    firm = 0.7 * np.asarray(hold.share)[:, None]
    spring = 70.0 * (p + np.asarray(hold.point) @ R.T - np.asarray(state.x)[at])
    expected = np.zeros((len(SHEET.vertices), 3))
    expected[at] = firm * (spring + 0.3 * (speed - np.asarray(state.v)[at]))
    np.testing.assert_allclose(cp.join_vector(pull.force), expected, atol=1e-9)
    np.testing.assert_allclose(pull.rate[at], firm[:, 0] * (scene.dt * 70.0 + 0.3), rtol=1e-12)
    assert float(jnp.sum(pull.rate != 0.0)) == len(at)


def test_holds_follow_at_their_rate(x64):
    grasp = thin.Grasp(radius=0.2, stiffness=70.0, body=1, slip_time=2e-3)
    scene, state = cloth_scene(grasps=(grasp,)), shaken(SHEET)
    before, after = moving_hand()
    x = cp.split_vector(state.x)
    (start,), (there,) = (grasp_forces.open_holds(scene, state.x, poses) for poses in (before, after))
    (end,) = grasp_forces.join_holds(
        grasp_forces.followed(scene, grasp_forces.split_holds((start,)), x, after, jnp.array([0.3]))
    )
    follows = 1.0 - np.exp(-scene.dt * 0.7**4 / 2e-3)
    for one, two, found in ((start.point, there.point, end.point), (start.share, there.share, end.share)):
        np.testing.assert_allclose(found - one, follows * (two - one), rtol=1e-8, atol=1e-15)
    assert 0.0 < float(start.share.max()) <= 1.0


def test_a_nearly_closed_grip_creeps_in_single_precision_too():
    """1 - exp(-rate) would be rounded to a multiple of 6e-8, or to 0."""
    grasp = thin.Grasp(stiffness=70.0, slip_time=2e-3, vertices=tuple(range(len(SHEET.vertices))))
    scene, state = cloth_scene(grasps=(grasp,)), shaken(SHEET)
    x = cp.split_vector(state.x.astype(jnp.float32))
    hold = Hold(point=jnp.zeros(state.x.shape, jnp.float32), share=jnp.ones(len(state.x), jnp.float32))
    poses = Pose(jnp.zeros((1, 3), jnp.float32), jnp.eye(3, dtype=jnp.float32)[None])
    (end,) = grasp_forces.join_holds(
        grasp_forces.followed(scene, grasp_forces.split_holds((hold,)), x, poses, jnp.array([0.98], jnp.float32))
    )
    follows = -np.expm1(-scene.dt * (1.0 - np.float64(np.float32(0.98))) ** 4 / 2e-3)
    assert follows < 3e-8
    np.testing.assert_allclose(end.point, follows * np.asarray(state.x, np.float64), rtol=1e-5, atol=1e-20)
