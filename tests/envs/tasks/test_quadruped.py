"""Quadruped: its model, formulas in numpy, controllers, stance, ends."""

import numpy as np
import pytest
import rigid_tasks as tasks
from scipy.spatial.transform import Rotation

LEGS = ["left_front", "right_front", "left_hind", "right_hind"]
JOINTS = [f"{leg}_{joint}" for leg in LEGS for joint in ("spread", "swing", "knee")]
STANCE = np.array([0, 0.6, -1.2, 0, 0.6, -1.2, 0, -0.6, 1.2, 0, -0.6, 1.2])


def test_the_model():
    env = tasks.make("Quadruped", "paper")
    assert (env.num_substeps, env.max_steps) == (20, 1000) and env.control_dt == pytest.approx(0.02)
    small = tasks.make("Quadruped")
    assert (small.num_substeps, small.max_steps) == (8, 300) and small.control_dt == pytest.approx(0.02)
    assert sum(tasks.masses("Quadruped").values()) == pytest.approx(30.0)
    assert tasks.joint_names("Quadruped") == JOINTS and tasks.actuated("Quadruped") == JOINTS
    front, hind = ([[-0.6, 0.6], [-1.3, 1.3], knee] for knee in ([-2.4, -0.2], [0.2, 2.4]))
    np.testing.assert_allclose(tasks.ranges("Quadruped"), [*front, *front, *hind, *hind])
    np.testing.assert_allclose(env.stance, STANCE, rtol=1e-6)
    np.testing.assert_allclose(env.up, [0.0, 0.0, 1.0])


def torques(q, v, action):
    """Of the joints' controllers: 80 N m/rad, 3 N m s/rad, at most 50 N m."""
    return np.clip(80.0 * (STANCE + 0.35 * action - q[:, 7:]) - 3.0 * v[:, 6:], -50.0, 50.0)


def square(vectors):
    return np.sum(np.square(vectors), axis=1)


def test_the_formulas():
    heights = np.array([0.2, 0.24, 0.26, 0.4, 0.5, 0.6])
    physics, q, v, action, previous = tasks.random_physics("Quadruped", 0, columns={2: heights})
    # Three level orientations among the random ones, so that not all are fallen.
    q[3:, 3:7] = [[1, 0, 0, 0], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], [np.cos(0.2), np.sin(0.2), 0, 0]]
    physics = physics.replace(rigid=physics.rigid.replace(qpos=np.float32(q)))
    turn = tasks.rotations(q)
    velocity = np.einsum("nij,ni->nj", turn, v[:, :3])
    gravity = -turn[:, 2]
    columns = [velocity, v[:, 3:6], gravity, q[:, 7:] - STANCE, 0.1 * v[:, 6:], action]
    expected = np.concatenate(columns, axis=1)
    assert expected.shape[1] == 45
    np.testing.assert_allclose(tasks.observed("Quadruped", physics), expected, atol=2e-6)
    reward = 2.0 * np.exp(-2.0 * square(velocity[:, :2] - [1.0, 0.0])) + 0.2 * np.exp(-4.0 * v[:, 5] ** 2)
    reward += -0.5 * v[:, 2] ** 2 - 0.05 * square(v[:, 3:5]) - square(gravity[:, :2])
    reward += -2e-5 * square(torques(q, v, action)) - 0.01 * square(action - previous)
    np.testing.assert_allclose(tasks.rewarded("Quadruped", physics), reward, rtol=1e-5, atol=1e-5)
    fallen = (heights < 0.25) | (turn[:, 2, 2] < 0.5)
    assert fallen.any() and not fallen.all()
    np.testing.assert_array_equal(tasks.terminated("Quadruped", physics), fallen)


def test_the_start():
    q, v = tasks.starts("Quadruped")
    np.testing.assert_allclose(q[:, :3], np.tile([0.0, 0.0, 0.49], (len(q), 1)), atol=1e-6)
    tasks.assert_uniform(q[:, 7:], STANCE, 0.1)
    tasks.assert_uniform(v, 0.0, 0.1)
    angle = Rotation.from_quat(q[:, [4, 5, 6, 3]]).magnitude()
    assert 0.99 * np.pi / 36 < angle.max() <= np.pi / 36 + 1e-4 and angle.mean() == pytest.approx(np.pi / 72, rel=0.03)


def test_a_step_in_the_air_is_mujocos():
    """Controllers among it: what an action aims at, and how hard."""
    ours, mujocos, rest = tasks.step_in_the_air("Quadruped")
    np.testing.assert_allclose(ours, mujocos, atol=1e-3)
    assert np.abs(mujocos - rest).max() > 0.05


def test_without_action_it_stands():
    """On its feet, with its weight on the controllers, and no episode ends but by time."""
    depths = np.array(tasks.resting_depths("Quadruped"))
    assert np.all((depths > 0.0) & (depths < 0.015))
    # Four springs of 1e4 N/m carry 30 kg.
    assert depths.mean() == pytest.approx(30.0 * 9.81 / 4e4, rel=0.2)
    state = tasks.start("Quadruped")
    for _ in range(60):
        state = tasks.step("Quadruped")(state, np.zeros((tasks.NUM_ENVS, 12), np.float32))
        assert not np.asarray(state.terminated).any()
    height = np.asarray(state.physics.rigid.qpos[:, 2])
    assert height.min() > 0.4
    # Standing still is worth the share of the command that standing earns.
    assert np.asarray(state.reward).mean() == pytest.approx(2.0 * np.exp(-2.0) + 0.2, abs=0.05)


def test_the_change_of_the_action_costs():
    """The first action is compared with none, the second with the first."""
    first = tasks.step("Quadruped")(tasks.start("Quadruped"), np.full((tasks.NUM_ENVS, 12), 0.1, np.float32))
    np.testing.assert_allclose(first.metrics["change"], 12 * 0.1**2, rtol=1e-4)
    second = tasks.step("Quadruped")(first, np.full((tasks.NUM_ENVS, 12), 0.3, np.float32))
    np.testing.assert_allclose(second.metrics["change"], 12 * 0.2**2, rtol=1e-4)


@pytest.mark.slow
def test_gradients_stay_small_over_a_rollout():
    """Of rewards with respect to actions, 24 steps on, from any start."""
    gradient = tasks.gradient("Quadruped", num_steps=24)
    size = np.linalg.norm(gradient.reshape(64, -1), axis=1)
    assert np.isfinite(gradient).all() and size.min() > 1e-3 and size.max() < 200.0
