"""AntRun and Ant: formulas of the reference in numpy, the model's masses and joints, falls, torques and gradients."""

import mujoco
import numpy as np
import pytest
import rigid_tasks as tasks
from scipy.spatial.transform import Rotation

ANTS = ["AntRun", pytest.param("Ant", marks=pytest.mark.slow)]


def test_the_reference_constants():
    env = tasks.make("AntRun", "paper")
    assert (env.num_substeps, env.max_steps) == (16, 1000) and env.control_dt == pytest.approx(1 / 60)
    assert (tasks.make("AntRun").num_substeps, tasks.make("AntRun").max_steps) == (8, 300)
    penalty, parameters = env.model.penalty, env.model.parameters
    law = [penalty.stiffness, penalty.damping, penalty.friction_damping, penalty.limit_stiffness, penalty.limit_damping]
    np.testing.assert_allclose(law, [52e3, 1e3, 650.0, 1e3, 10.0])
    among = penalty.among
    law = [among.stiffness, among.damping, among.friction_damping, among.onset]
    np.testing.assert_allclose(law, [4e3, 1e3, 300.0, 0.0])
    assert penalty.at_surfaces and among.among is None
    np.testing.assert_allclose(parameters["pair_friction"][:13, :2], 0.625)
    np.testing.assert_allclose(parameters["dof_armature"], [0.0] * 6 + [0.005] * 8)
    assert not parameters["dof_damping"].any() and not parameters["jnt_stiffness"].any()
    np.testing.assert_allclose(env.model.gravity, [0.0, -9.81, 0.0])
    np.testing.assert_allclose(env.up, [0.0, 1.0, 0.0])


def test_the_suites_ant_differs_in_contacts_and_armature():
    env = tasks.make("Ant", "paper")
    assert (env.num_substeps, env.max_steps) == (16, 1000)
    penalty = env.model.penalty
    law = [penalty.stiffness, penalty.damping, penalty.depth_damping, penalty.friction_damping]
    np.testing.assert_allclose(law, [4e4, 0.0, 1e4, 3e3])
    np.testing.assert_allclose(env.model.parameters["pair_friction"][:, :2], 0.75)
    np.testing.assert_allclose(env.model.parameters["dof_armature"], [0.0] * 6 + [0.05] * 8, rtol=1e-6)


def test_masses():
    masses = tasks.masses("AntRun")
    assert masses["torso"] == pytest.approx(0.327 + 4 * 7.83, abs=0.01)
    for leg in range(1, 5):
        assert masses[f"hip_{leg}"] == pytest.approx(7.83, abs=0.005)
        assert masses[f"ankle_{leg}"] == pytest.approx(13.52, abs=0.005)
    assert sum(masses.values()) == pytest.approx(117.05, abs=0.01)


def test_joints():
    legs = ["hip_1", "ankle_1", "hip_2", "ankle_2", "hip_3", "ankle_3", "hip_4", "ankle_4"]
    assert tasks.joint_names("AntRun") == legs and tasks.actuated("AntRun") == legs
    hip, bent, back = [-40, 40], [30, 100], [-100, -30]
    expected = [hip, bent, hip, back, hip, back, hip, bent]
    np.testing.assert_allclose(np.rad2deg(tasks.ranges("AntRun")), expected, atol=1e-9)
    np.testing.assert_array_equal(tasks.make("AntRun").model.parameters["actuator_gear"][:, 0], 200.0)


def test_legs_stand_in_the_four_quarters_of_the_ground():
    """Front left, front right, back left, back right of one who looks along y, in the ant's own frame."""
    env = tasks.make("AntRun")
    data = mujoco.MjData(env.model.static.mj)
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    mujoco.mj_kinematics(env.model.static.mj, data)
    ankles = np.stack([data.body(f"ankle_{leg}").xpos for leg in range(1, 5)])
    np.testing.assert_allclose(ankles, [[0.4, 0.4, 0], [-0.4, 0.4, 0], [-0.4, -0.4, 0], [0.4, -0.4, 0]], atol=1e-12)


@pytest.mark.parametrize("name", ANTS)
def test_observation_and_reward(name):
    physics, q, v, action, _ = tasks.random_physics(name, 0)
    turn = tasks.rotations(q)
    upright = turn[:, 1, 2]  # the model is written z up
    ahead = np.array([1e4, 0.0, 0.0]) - q[:, :3] * [1, 0, 1]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    heading = np.sum(turn[:, :, 0] * ahead, axis=1)
    spin = np.einsum("nij,nj->ni", turn, v[:, 3:6])
    columns = [q[:, 1:2], q[:, 4:7], q[:, 3:4], v[:, :3], spin, q[:, 7:], 0.1 * v[:, 6:]]
    expected = np.concatenate([*columns, upright[:, None], heading[:, None], action], axis=1)
    assert expected.shape[1] == 37
    np.testing.assert_allclose(tasks.observed(name, physics), expected, atol=2e-6)
    reward = v[:, 0] + 0.1 * upright + heading + (q[:, 1] - 0.27)
    np.testing.assert_allclose(tasks.rewarded(name, physics), reward, atol=2e-6)
    np.testing.assert_array_equal(tasks.terminated(name, physics), q[:, 1] < 0.27)


def test_the_start():
    q, v = tasks.starts("AntRun")
    tasks.assert_uniform(q[:, :3], [0, 0.75, 0], 0.1)
    tasks.assert_uniform(q[:, 7:], [0, 1, 0, -1, 0, -1, 0, 1], 0.2)
    tasks.assert_uniform(v, 0.0, 0.25)
    # From the upright orientation the ant is turned, in its own frame, about an axis of any direction.
    upright = Rotation.from_euler("x", -np.pi / 2)
    turn = (upright.inv() * Rotation.from_quat(q[:, [4, 5, 6, 3]])).as_rotvec()
    angle = np.linalg.norm(turn, axis=1)
    assert angle.max() <= np.pi / 24 + 1e-4 and angle.max() > 0.99 * np.pi / 24
    assert angle.mean() == pytest.approx(np.pi / 48, rel=0.03)
    axes = turn / angle[:, None]
    np.testing.assert_allclose(axes.mean(axis=0), 0.0, atol=0.05)
    np.testing.assert_allclose(axes.T @ axes / len(axes), np.eye(3) / 3, atol=0.03)


def test_a_step_in_the_air_is_mujocos():
    """Order, sign and size of torques: a positive action turns its joint backwards."""
    ours, mujocos, rest = tasks.step_in_the_air("AntRun")
    np.testing.assert_allclose(ours, mujocos, atol=2e-4)
    assert np.abs(mujocos - rest)[:, -8:].max() > 0.1


def test_without_action_it_comes_to_rest_on_the_ground():
    depths = np.array(tasks.resting_depths("AntRun"))
    assert np.all((depths > 0.0) & (depths < 0.015))


def test_it_is_over_once_the_torso_is_low():
    """On its back at 26 cm, not at 75 cm; where it is over, the time limit no longer counts."""
    state = tasks.start("AntRun")
    bodies, back = state.physics.rigid, np.sqrt(0.5) * np.array([1.0, 1.0, 0.0, 0.0])
    qpos = bodies.qpos.at[:4, 1].set(0.26).at[4:, 1].set(0.75).at[:, 3:7].set(back)
    physics = state.physics.replace(rigid=bodies.replace(qpos=qpos, qvel=0.0 * bodies.qvel))
    late = state.replace(physics=physics, step_count=state.step_count + 299)
    after = tasks.step("AntRun")(late, np.zeros((tasks.NUM_ENVS, 8), np.float32))
    np.testing.assert_array_equal(after.terminated, np.arange(8) < 4)
    np.testing.assert_array_equal(after.truncated, np.arange(8) >= 4)


@pytest.mark.parametrize("name", ANTS)
def test_gradients_of_a_few_steps_are_finite_from_any_start(name):
    gradient = tasks.gradient(name)
    assert np.isfinite(gradient).all()
    size = np.linalg.norm(gradient.reshape(64, -1), axis=1)
    assert size.min() > 1e-3 and np.median(size) < 10.0
