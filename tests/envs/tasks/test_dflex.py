"""The dflex suite: DiffRL's observations, rewards and ends in numpy, models against the tables, MuJoCo and falls."""

import mujoco
import numpy as np
import pytest
import rigid_tasks as tasks
from rigid_tasks import capsule
from scipy.spatial.transform import Rotation

PLANAR = ["Hopper", "HalfCheetah"]
WALKERS = [*PLANAR, "Humanoid"]
ALL = ["CartpoleSwingUp", *WALKERS]
HOPPER = ["thigh", "leg", "foot"]
CHEETAH = ["back_thigh", "back_shin", "back_foot", "front_thigh", "front_shin", "front_foot"]
LEG = ["hip_x", "hip_z", "hip_y", "knee", "ankle_y", "ankle_x"]
ARM = ["shoulder1", "shoulder2", "elbow"]
HUMANOID = [
    *("abdomen_z", "abdomen_y", "abdomen_x"),
    *(f"{side}_{joint}" for part in (LEG, ARM) for side in ("right", "left") for joint in part),
]


# --- Models against the tables ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "substeps", "steps", "contact", "friction"),
    [
        ("Hopper", (16, 16), 1000, {"stiffness": 2e4, "damping": 1e3, "friction_damping": 1e3}, 0.9),
        ("HalfCheetah", (16, 8), 1000, {"stiffness": 2e4, "damping": 1e3, "friction_damping": 1e3}, 1.0),
        ("Humanoid", (48, 16), 1000, {"stiffness": 2e4, "depth_damping": 5e3, "friction_damping": 1e3}, 0.75),
    ],
)
def test_constants(name, substeps, steps, contact, friction):
    paper, small = tasks.make(name, "paper"), tasks.make(name)
    assert (paper.num_substeps, paper.max_steps) == (substeps[0], steps)
    assert (small.num_substeps, small.max_steps) == (substeps[1], 300)
    for env in (paper, small):
        assert env.control_dt == pytest.approx(1 / 60)
        law = {"damping": 0.0, "depth_damping": 0.0, "limit_stiffness": 1e3, "limit_damping": 10.0, **contact}
        if name == "Humanoid" and env is small:
            law["friction_damping"] = 3e2  # what its substep can follow
        for key, value in law.items():
            assert float(getattr(env.model.penalty, key)) == pytest.approx(value), key
        np.testing.assert_allclose(env.model.parameters["pair_friction"][:, :2], friction, rtol=1e-6)
        assert np.linalg.norm(env.model.gravity) == pytest.approx(9.81)


def test_constants_of_the_cartpole():
    env = tasks.make("CartpoleSwingUp")
    assert (env.num_substeps, env.max_steps) == (4, 240) and env.control_dt == pytest.approx(1 / 60)
    assert tasks.masses("CartpoleSwingUp") == {"cart": 1.0, "pole": 10.0}
    mj = env.model.static.mj
    np.testing.assert_array_equal(mj.body_inertia[1:], 1.0)
    np.testing.assert_array_equal(mj.body_ipos[2], [0.0, 0.0, 0.5])
    np.testing.assert_array_equal(tasks.ranges("CartpoleSwingUp"), [[-4.0, 4.0]])
    assert float(env.model.parameters["actuator_gear"][0, 0]) == 1000.0


def test_masses():
    """Capsules of density 1000."""
    sizes = {"torso": (0.05, 0.2), "thigh": (0.05, 0.225), "leg": (0.04, 0.25), "foot": (0.06, 0.195)}
    expected = {name: capsule(*size) for name, size in sizes.items()}
    assert tasks.masses("Hopper") == pytest.approx(expected)
    halves = dict(zip(CHEETAH, (0.145, 0.15, 0.094, 0.133, 0.106, 0.07), strict=True))
    expected = {name: capsule(0.046, half) for name, half in halves.items()}
    expected["torso"] = capsule(0.046, 0.5) + capsule(0.046, 0.15)
    assert tasks.masses("HalfCheetah") == pytest.approx(expected)

    head, hand = capsule(0.09, 0.0), capsule(0.04, 0.0)
    expected = {
        "torso": capsule(0.07, 0.07) + capsule(0.06, 0.06) + head,
        "lower_waist": capsule(0.06, 0.06),
        "pelvis": capsule(0.09, 0.07),
    }
    for side in ("right", "left"):
        expected[f"{side}_thigh"] = capsule(0.06, 0.5 * np.hypot(0.34, 0.01))
        expected[f"{side}_shin"] = capsule(0.049, 0.15)
        expected[f"{side}_foot"] = 2.0 * capsule(0.027, 0.5 * np.hypot(0.21, 0.02))
        expected[f"{side}_upper_arm"] = capsule(0.04, 0.08 * np.sqrt(3.0))
        expected[f"{side}_lower_arm"] = capsule(0.031, 0.08 * np.sqrt(3.0)) + hand
    assert tasks.masses("Humanoid") == pytest.approx(expected)


def test_joints_of_the_planar_models():
    root = ["root_x", "root_z", "root_pitch"]
    assert tasks.joint_names("Hopper") == [*root, *HOPPER] and tasks.actuated("Hopper") == HOPPER
    np.testing.assert_allclose(tasks.ranges("Hopper"), [[-2.618, 0], [-2.618, 0], [-0.785, 0.785]])
    assert tasks.joint_names("HalfCheetah") == [*root, *CHEETAH] and tasks.actuated("HalfCheetah") == CHEETAH
    back, front = [[-0.52, 1.05], [-0.785, 0.785], [-0.4, 0.785]], [[-1.5, 0.8], [-1.2, 1.1], [-3.1, -0.3]]
    np.testing.assert_allclose(tasks.ranges("HalfCheetah"), [*back, *front])
    for name, armature in (("Hopper", 1.0), ("HalfCheetah", 0.1)):
        parameters = tasks.make(name).model.parameters
        np.testing.assert_array_equal(parameters["actuator_gear"][:, 0], 200.0)
        np.testing.assert_allclose(parameters["dof_armature"][:3], 0.0)
        np.testing.assert_allclose(parameters["dof_armature"][3:], armature)
    cheetah, hopper = (tasks.make(name).model.parameters for name in ("HalfCheetah", "Hopper"))
    np.testing.assert_allclose(cheetah["jnt_stiffness"], [0, 0, 0, 240, 180, 120, 180, 120, 60])
    np.testing.assert_allclose(cheetah["dof_damping"], [0, 0, 0, 6, 4.5, 3, 4.5, 3, 1.5])
    assert not hopper["jnt_stiffness"].any() and not hopper["dof_damping"].any()


def test_joints_of_the_humanoid():
    assert tasks.joint_names("Humanoid") == HUMANOID and tasks.actuated("Humanoid") == HUMANOID
    leg = [[-25, 5], [-60, 35], [-80, 20], [-160, 2], [-50, 50], [-50, 50]]
    arm = [[-60, 60], [-60, 60], [-90, 50]]
    expected = [[-45, 45], [-75, 30], [-35, 35], *leg, *leg, *arm, *arm]
    np.testing.assert_allclose(np.rad2deg(tasks.ranges("Humanoid")), expected, atol=1e-9)
    leg, arm = [200, 200, 600, 400, 100, 100], [100, 100, 200]
    strength = 0.35 * np.array([200, 200, 200, *leg, *leg, *arm, *arm])
    np.testing.assert_allclose(tasks.make("Humanoid").model.parameters["actuator_gear"][:, 0], strength, rtol=1e-6)


def test_the_humanoid_is_its_own_mirror_image():
    """Mirrored angles, which are those of the other side (abdomen z and x change sign), mirror every body."""
    mj = tasks.make("Humanoid").model.static.mj
    angles = np.random.default_rng(0).uniform(-0.4, 0.4, 21)
    order = [HUMANOID.index(n.replace("right", "?").replace("left", "right").replace("?", "left")) for n in HUMANOID]
    mirrored = angles[order] * np.where(np.isin(HUMANOID, ["abdomen_z", "abdomen_x"]), -1, 1)
    mirrored *= np.where(np.isin(HUMANOID, ["right_ankle_x", "left_ankle_x"]), -1, 1)  # the same sense on both sides
    places = []
    for joints in (angles, mirrored):
        data = mujoco.MjData(mj)
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *joints]
        mujoco.mj_kinematics(mj, data)
        places.append({mj.body(i).name: data.xpos[i].copy() for i in range(1, mj.nbody)})
    for name, place in places[0].items():
        other = name.replace("right", "?").replace("left", "right").replace("?", "left")
        np.testing.assert_allclose(places[1][other], place * [1, -1, 1], atol=1e-9, err_msg=name)


# --- Formulas ---------------------------------------------------------------------------------------------------------


def test_the_cartpoles_formulas():
    angles = np.array([0.3, 3.1, -3.2, 6.0, -9.0, 12.0])
    physics, q, v, _, _ = tasks.random_physics("CartpoleSwingUp", 0, columns={1: angles})
    (x, angle), (velocity, rate) = q.T, v.T
    expected = np.stack([x, velocity, np.sin(angle), np.cos(angle), rate], axis=1)
    np.testing.assert_allclose(tasks.observed("CartpoleSwingUp", physics), expected, atol=2e-6)
    wrapped = np.arctan2(np.sin(angle), np.cos(angle))
    reward = -(wrapped**2) - 0.1 * rate**2 - 0.05 * x**2 - 0.1 * velocity**2
    np.testing.assert_allclose(tasks.rewarded("CartpoleSwingUp", physics), reward, atol=1e-5)
    assert not tasks.terminated("CartpoleSwingUp", physics).any()


def test_the_hoppers_formulas():
    heights = np.array([-1.5, -0.46, -0.44, -0.2, -0.1, 0.4])
    physics, q, v, action, _ = tasks.random_physics("Hopper", 0, columns={1: heights})
    expected = np.concatenate([q[:, 1:], v], axis=1)
    assert expected.shape[1] == 11
    np.testing.assert_allclose(tasks.observed("Hopper", physics), expected, atol=2e-6)
    e = np.clip(heights + 0.3, -1.0, 0.3)
    tall = np.where(e < 0.0, -200.0 * e**2, e)
    pitch = 1.0 - q[:, 2] ** 2 / (np.pi / 6) ** 2
    reward = v[:, 0] + tall + pitch - 0.1 * np.sum(action**2, axis=1)
    np.testing.assert_allclose(tasks.rewarded("Hopper", physics), reward, rtol=1e-5)
    np.testing.assert_array_equal(tasks.terminated("Hopper", physics), [True, True, False, False, False, False])


def test_the_half_cheetahs_formulas():
    physics, q, v, action, _ = tasks.random_physics("HalfCheetah", 0)
    expected = np.concatenate([q[:, 1:], v], axis=1)
    assert expected.shape[1] == 17
    np.testing.assert_allclose(tasks.observed("HalfCheetah", physics), expected, atol=2e-6)
    reward = v[:, 0] - 0.1 * np.sum(action**2, axis=1)
    np.testing.assert_allclose(tasks.rewarded("HalfCheetah", physics), reward, atol=2e-6)
    assert not tasks.terminated("HalfCheetah", physics).any()


def test_the_humanoids_formulas():
    heights = np.array([-0.5, 0.73, 0.75, 0.83, 0.9, 1.5])
    physics, q, v, action, _ = tasks.random_physics("Humanoid", 0, columns={1: heights})
    turn = tasks.rotations(q)
    ahead = np.array([200.0, 0.0, 0.0]) - q[:, :3] * [1, 0, 1]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    upright, heading = turn[:, 1, 2], np.sum(turn[:, :, 0] * ahead, axis=1)
    spin = np.einsum("nij,nj->ni", turn, v[:, 3:6])
    columns = [q[:, 1:2], q[:, 4:7], q[:, 3:4], v[:, :3], spin, q[:, 7:], 0.1 * v[:, 6:]]
    expected = np.concatenate([*columns, upright[:, None], heading[:, None], action], axis=1)
    assert expected.shape[1] == 76
    np.testing.assert_allclose(tasks.observed("Humanoid", physics), expected, atol=2e-6)
    e = np.clip(heights - 0.84, -1.0, 0.1)
    standing = np.where(e < 0.0, -200.0 * e**2, 10.0 * e)
    reward = v[:, 0] + 0.1 * upright + heading + standing - 0.002 * np.sum(action**2, axis=1)
    np.testing.assert_allclose(tasks.rewarded("Humanoid", physics), reward, rtol=2e-5)
    np.testing.assert_array_equal(tasks.terminated("Humanoid", physics), [True, True, False, False, False, False])


def test_starts():
    q, v = tasks.starts("CartpoleSwingUp")
    tasks.assert_uniform(q, [0.0, -np.pi], 0.5 * np.pi)
    tasks.assert_uniform(v, 0.0, 0.25)
    q, v = tasks.starts("Hopper")
    tasks.assert_uniform(q, 0.0, 0.05)
    tasks.assert_uniform(v, 0.0, 0.05)
    q, v = tasks.starts("HalfCheetah")
    tasks.assert_uniform(q, [0.0, -0.2] + [0.0] * 7, 0.1)
    tasks.assert_uniform(v, 0.0, 0.25)
    q, v = tasks.starts("Humanoid")
    tasks.assert_uniform(q[:, :3], [0.0, 1.35, 0.0], 0.1)
    tasks.assert_uniform(q[:, 7:], 0.0, 0.2)
    tasks.assert_uniform(v, 0.0, 0.25)
    turn = Rotation.from_euler("x", -np.pi / 2).inv() * Rotation.from_quat(q[:, [4, 5, 6, 3]])
    angle = np.linalg.norm(turn.as_rotvec(), axis=1)
    assert 0.99 * np.pi / 24 < angle.max() <= np.pi / 24 + 1e-4 and angle.mean() == pytest.approx(np.pi / 48, rel=0.03)


# --- Steps ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALL)
def test_a_step_in_the_air_is_mujocos(name):
    """Order, sign and size of torques, springs and dampers."""
    ours, mujocos, rest = tasks.step_in_the_air(name)
    np.testing.assert_allclose(ours, mujocos, atol=1e-3)
    assert np.abs(mujocos - rest).max() > 0.05


@pytest.mark.parametrize("name", WALKERS)
def test_without_action_it_comes_to_rest_on_the_ground(name):
    depths = np.array(tasks.resting_depths(name))
    assert np.all((depths > 0.0) & (depths < 0.015))


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_gradients_of_a_few_steps_are_finite_from_any_start(name):
    gradient = tasks.gradient(name)
    assert np.isfinite(gradient).all()
    assert np.linalg.norm(gradient.reshape(64, -1), axis=1).min() > 1e-3
