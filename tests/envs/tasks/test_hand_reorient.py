"""HandReorient: the hand by its table, formulas in numpy, goals, gradients."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import rigid_tasks as tasks
from scipy.spatial.transform import Rotation

import rewax
from rewax.envs.kit.rigid_task import RigidPhysics
from rewax.envs.tasks.hand_reorient import REFERENCE_CONTACT
from rewax.physics import rigid

NAME = "HandReorient"
FINGERS = ["ring", "middle", "index"]
LINKS = ["base", "proximal", "middle", "distal"]
JOINTS = [f"{finger}_{link}" for finger in ["thumb", *FINGERS] for link in LINKS]
GOAL = np.array([0.0, -0.1, 0.56])

# Origin in the parent, axis, limits, full sizes and centre of the box, mass.
THUMB = [
    (
        (-0.0182, 0.019333, -0.045987),
        (-1, 0, 0),
        (0.263, 1.396),
        (0.0358, 0.034, 0.0455),
        (-0.0179, 0.009, 0.0145),
        0.0176,
    ),
    ((-0.027, 0.005, 0.0399), (0, 0, 1), (-0.105, 1.163), (0.0196, 0.0275, 0.0177), (0, 0, 0.00885), 0.0119),
    ((0, 0, 0.0177), (0, 1, 0), (-0.189, 1.644), (0.0196, 0.0275, 0.0514), (0, 0, 0.0257), 0.038),
    ((0, 0, 0.0514), (0, 1, 0), (-0.162, 1.719), (0.0196, 0.0275, 0.0423), (0, 0, 0.02115), 0.0724),
]


def finger(y, z):
    return [
        ((0, y, z), (0, 0, 1), (-0.47, 0.47), (0.0196, 0.0275, 0.0164), (0, 0, 0.0082), 0.0119),
        ((0, 0, 0.0164), (0, 1, 0), (-0.196, 1.61), (0.0196, 0.0275, 0.054), (0, 0, 0.027), 0.065),
        ((0, 0, 0.054), (0, 1, 0), (-0.174, 1.709), (0.0196, 0.0275, 0.0384), (0, 0, 0.0192), 0.0355),
        ((0, 0, 0.0384), (0, 1, 0), (-0.227, 1.618), (0.0196, 0.0275, 0.0267), (0, 0, 0.01335), 0.0432),
    ]


TABLE = [*THUMB, *finger(-0.0435, -0.001542), *finger(0, 0.0007), *finger(0.0435, -0.001542)]
LOW, HIGH = np.array([row[2] for row in TABLE]).T
CENTER_OF_MASS = {"thumb_distal": 0.01963, **{f"{f}_distal": 0.02077 for f in FINGERS}}  # along z, with the tips
# Moments of inertia of the URDF's links about x, y and z [kg m^2], without products.
THUMB_MOMENTS = {
    "base": (1.89273333333e-05, 1.43008213333e-05, 1.89273333333e-05),
    "proximal": (4.24250866667e-06, 4.52362633333e-06, 4.24250866667e-06),
    "middle": (4.30439933333e-05, 1.44451933333e-05, 4.30439933333e-05),
    "distal": (3.29223173333e-05, 1.47493026667e-05, 3.29223173333e-05),
}
FINGER_MOMENTS = {
    "base": (1.01666658333e-06, 6.47677333333e-07, 1.01666658333e-06),
    "proximal": (7.95654166667e-05, 2.47088833333e-05, 7.95654166667e-05),
    "middle": (2.63979183333e-05, 1.34948516667e-05, 2.63979183333e-05),
    "distal": (4.701248e-06, 3.649312e-06, 4.701248e-06),
}
TURN = {"thumb_base": (0, -1.65806, -1.5708), "ring_base": (np.pi / 36, 0, 0), "index_base": (-np.pi / 36, 0, 0)}


def rotation(wxyz):
    return Rotation.from_quat(np.asarray(wxyz)[..., [1, 2, 3, 0]])


def moments_of(name):
    """Of a link; of distal ones together with two tips of 16.8 g, about the centre of mass."""
    finger, link = name.split("_")
    moments = np.array((THUMB_MOMENTS if finger == "thumb" else FINGER_MOMENTS)[link])
    if link == "distal":
        own, tip = (0.0388, 0.0423) if finger == "thumb" else (0.0096, 0.0267)
        center = CENTER_OF_MASS[name]
        across = own * center**2 + 2 * 0.0168 * (tip - center) ** 2
        moments = moments + 2 * 9.68e-7 + np.array([across, across, 0.0])
    return moments


def xyzw(q):
    return q[..., [1, 2, 3, 0]]


def unit(a):
    return a / np.linalg.norm(a, axis=-1, keepdims=True)


# --- The model --------------------------------------------------------------------------------------------------------


def test_hand_and_cube_are_those_of_the_table():
    env = tasks.make(NAME)
    mj, parameters = env.model.static.mj, env.model.parameters
    assert tasks.joint_names(NAME) == tasks.actuated(NAME) == JOINTS
    np.testing.assert_allclose(tasks.ranges(NAME), np.stack([LOW, HIGH], axis=1))
    np.testing.assert_array_equal(parameters["actuator_gear"][:, 0], 2.0)
    np.testing.assert_allclose(parameters["dof_armature"], [1e-3] * 16 + [0.0] * 6)
    assert not parameters["dof_damping"].any() and not parameters["jnt_stiffness"].any()
    for name, (origin, axis, _, size, center, mass) in zip(JOINTS, TABLE, strict=True):
        body, geom = mj.body(name), mj.geom(name)
        np.testing.assert_allclose(body.pos, origin, atol=1e-9)
        turn = Rotation.from_euler("xyz", TURN.get(name, (0, 0, 0)))
        assert (rotation(body.quat).inv() * turn).magnitude() < 1e-6
        np.testing.assert_allclose(mj.joint(name).axis, axis)
        np.testing.assert_allclose(2 * geom.size, size, atol=1e-9)
        np.testing.assert_allclose(geom.pos, center, atol=1e-9)
        assert float(body.mass[0]) == pytest.approx(mass)
        # The URDF's links have their centres of mass at their origins, up to 27 mm from their boxes' centres.
        np.testing.assert_allclose(body.ipos, (0, 0, CENTER_OF_MASS.get(name, 0.0)), atol=1e-9)
        moments = rotation(body.iquat).as_matrix() @ np.diag(body.inertia) @ rotation(body.iquat).as_matrix().T
        np.testing.assert_allclose(moments, np.diag(moments_of(name)), rtol=1e-5, atol=1e-11)
    cube, palm = mj.body("cube"), mj.body("palm")
    assert float(cube.mass[0]) == pytest.approx(1820.67 * 0.065**3, rel=1e-4) and float(palm.mass[0]) == pytest.approx(
        0.4154
    )
    np.testing.assert_allclose(cube.inertia, 0.5 * 0.065**2 / 6, rtol=1e-6)
    np.testing.assert_allclose(palm.pos, [0, 0, 0.5])
    assert (rotation(palm.quat).inv() * Rotation.from_euler("xyz", [0, -0.53 * np.pi, 0.5 * np.pi])).magnitude() < 1e-6
    np.testing.assert_allclose(mj.geom("cube").size, 0.0325)
    np.testing.assert_allclose(2 * mj.geom("palm").size, [0.0408, 0.113, 0.095])
    np.testing.assert_allclose(mj.geom("palm").pos, [-0.0093, 0, -0.0475])
    np.testing.assert_allclose(parameters["pair_friction"][:, :2], 0.5)
    np.testing.assert_allclose(env.model.gravity, [0, 0, -9.81], rtol=1e-6)


def test_scales_and_the_references_contact():
    paper, small = tasks.make(NAME, "paper"), tasks.make(NAME)
    assert (paper.num_substeps, paper.max_steps) == (64, 600) and (small.num_substeps, small.max_steps) == (8, 150)
    assert paper.control_dt == pytest.approx(1 / 120) and small.control_dt == pytest.approx(1 / 120)
    assert paper.model.dt == pytest.approx(1.302e-4, rel=1e-3)
    for env in (paper, small):
        np.testing.assert_allclose(env.goal_position, GOAL, atol=1e-7)
        np.testing.assert_allclose([env.tolerance, env.fall_distance], [0.1, 0.24], rtol=1e-6)
    law = rewax.make(NAME, scale="paper", contact=REFERENCE_CONTACT).model.penalty
    numbers = [law.stiffness, law.damping, law.friction_damping, law.limit_stiffness, law.limit_damping, law.onset]
    np.testing.assert_array_equal(numbers, [500, 100, 100, 100, 10, 0])
    np.testing.assert_array_equal([paper.model.penalty.limit_stiffness, paper.model.penalty.limit_damping], [100, 10])


def test_the_hand_opens_upwards_under_the_cube():
    mj = tasks.make(NAME).model.static.mj
    data = mujoco.MjData(mj)
    mujoco.mj_kinematics(mj, data)
    assert data.body("palm").xmat.reshape(3, 3)[2, 0] > 0.99  # its front faces up
    tips = np.stack([data.geom(f"{finger}_tip").xpos for finger in FINGERS])
    assert np.all(tips[:, 1] < -0.12) and np.all(np.diff(tips[:, 0]) < -0.04)  # along -y, index at -x
    assert data.geom("thumb_tip").xpos[0] < -0.15  # the thumb sticks out on the index finger's side
    closed = data.qpos.copy()
    closed[np.arange(4, 16)] = np.tile([0, 1.0, 1.0, 1.0], 3)
    data.qpos[:] = closed
    mujoco.mj_kinematics(mj, data)
    assert np.all(np.stack([data.geom(f"{finger}_tip").xpos for finger in FINGERS])[:, 2] > tips[:, 2] + 0.05)


def test_a_step_in_the_air_is_mujocos():
    """Order, sign and size of torques, gravity, the cube's fall; the thumb turned off the palm."""
    ours, theirs, rest = tasks.step_in_the_air(NAME, columns={0: 1.25, 18: 1.5})
    np.testing.assert_allclose(ours, theirs, atol=2e-3)
    assert np.abs(theirs - rest)[:, 23:39].min(axis=0).max() > 0.1 and np.abs(theirs - rest)[:, 16:19].max() < 1e-9


# --- Formulas ---------------------------------------------------------------------------------------------------------


def states(seed, num=32):
    """States anywhere with goals and actions: as the task sees them, and in numpy."""
    env, rng = tasks.make(NAME), np.random.default_rng(seed)
    q, v = rng.uniform(-1.0, 1.0, (num, 23)), rng.uniform(-2.0, 2.0, (num, 22))
    q[:, 16:19] = GOAL + rng.uniform(-0.2, 0.2, (num, 3))
    q[:, 19:], goal = unit(rng.standard_normal((num, 4))), unit(rng.standard_normal((num, 4)))
    return q, v, goal, rng.uniform(-1.0, 1.0, (num, 16)), env


def seen(env, q, v, goal, action):
    bodies = jax.vmap(lambda q, v: rigid.initial_state(env.model, q, v))(jnp.float32(q), jnp.float32(v))
    return RigidPhysics(rigid=bodies, action=jnp.float32(action), task=jnp.float32(goal))


def product(a, b):
    """Of quaternions w, x, y, z."""
    w, x, y, z = a.T
    r, i, j, k = b.T
    parts = [w * r - x * i - y * j - z * k, w * i + x * r + y * k - z * j, w * j - x * k + y * r + z * i]
    return np.stack([*parts, w * k + x * j - y * i + z * r], axis=1)


def test_the_observation():
    q, v, goal, action, env = states(0)
    spin = rotation(q[:, 19:]).apply(v[:, 19:])
    turn = product(q[:, 19:], goal * [1, -1, -1, -1])
    columns = [(2 * q[:, :16] - HIGH - LOW) / (HIGH - LOW), 0.2 * v[:, :16], q[:, 16:19], xyzw(q[:, 19:]), v[:, 16:19]]
    columns += [0.2 * spin, np.tile(GOAL, (len(q), 1)), xyzw(goal), xyzw(turn), action]
    expected = np.concatenate(columns, axis=1)
    assert expected.shape[1] == 72
    np.testing.assert_allclose(tasks.observed(NAME, seen(env, q, v, goal, action)), expected, atol=3e-6)


def sigmoid(x):
    return 0.5 * (1.0 + np.tanh(0.5 * x))


ANGLES = np.array([0.0, 0.02, 0.05, 0.09, 0.0925, 0.0935, 0.094, 0.095, 0.099, 0.101, 0.15, 0.5, 1.5, 3.0, 3.1, np.pi])


def test_the_reward():
    """At all kinds of angles, those where the bonus sets in among them."""
    q, v, goal, action, env = states(1)
    angles = np.concatenate([ANGLES, np.random.default_rng(2).uniform(0.2, 3.0, 16)])
    axis = unit(np.random.default_rng(3).standard_normal((32, 3)))
    turn = np.concatenate([np.cos(angles / 2)[:, None], np.sin(angles / 2)[:, None] * axis], axis=1)
    q[:, 19:] = product(turn, goal)
    q[::2, 19:] *= -1.0  # the same orientations
    distance = np.linalg.norm(q[:, 16:19] - GOAL, axis=1)
    theta = 2 * np.arcsin(np.minimum(np.sin(angles / 2), 0.999))
    reached = 1 - sigmoid((theta - 0.1) / 1e-3)
    bonus = sigmoid(-np.abs(reached - 1) / 1e-3)
    reward = -10 * distance + 1 / (theta + 0.1) - 0.0002 * np.sum(action**2, axis=1)
    reward = bonus * (reward + 250) + (1 - bonus) * reward
    physics = seen(env, q, v, goal, action)
    found, metrics = jax.jit(jax.vmap(env.reward))(physics)
    # Single precision knows these angles to 1e-6, a thousandth of the width of the bonus's edge.
    edge = (ANGLES > 0.092) & (ANGLES < 0.096)
    tolerance = np.where(np.pad(edge, (0, 16)), 1.0, 2e-3)
    assert np.all(np.abs(found - reward) < tolerance)
    assert bonus[0] == pytest.approx(0.5) and 0.05 < bonus[5] < 0.49 and bonus[9:].max() < 1e-6
    np.testing.assert_allclose(metrics["distance"], distance, rtol=1e-5)
    np.testing.assert_allclose(metrics["angle"], theta, atol=1e-5)
    np.testing.assert_array_equal(metrics["reached"], theta <= 0.1)


def test_derivatives_of_the_reward_are_finite_where_angles_and_distances_have_none():
    q, v, goal, action, env = states(4)
    angles = np.concatenate([[0.0, np.pi, 0.1, 0.0935], np.full(28, 1e-6)])
    turn = np.stack([np.cos(angles / 2), np.sin(angles / 2), 0 * angles, 0 * angles], axis=1)
    q[:, 19:] = product(turn, goal)
    q[0, 19:], q[1, 19:] = goal[0], goal[1][[1, 0, 3, 2]] * [-1, 1, -1, 1]  # exactly there, and exactly opposite
    q[:8, 16:19] = GOAL
    physics = seen(env, q, v, goal, action)
    slope = jax.jit(jax.vmap(jax.grad(lambda p: env.reward(p)[0] + jnp.sum(env.observe(p)["state"]))))(physics)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))


def test_it_is_over_once_the_cube_is_24_cm_away():
    q, v, goal, action, env = states(5, num=8)
    direction = unit(np.random.default_rng(6).standard_normal((8, 3)))
    q[:, 16:19] = GOAL + direction * np.array([0.0, 0.1, 0.2, 0.2399, 0.2401, 0.3, 1.0, 9.0])[:, None]
    np.testing.assert_array_equal(tasks.terminated(NAME, seen(env, q, v, goal, action)), np.arange(8) >= 4)


def test_the_start():
    q, v = tasks.starts(NAME)
    assert not v.any()
    tasks.assert_uniform(q[:, :16], 0.1 * (LOW + HIGH), 0.1 * (HIGH - LOW))
    tasks.assert_uniform(q[:, 16:19], [0, -0.1, 0.6], 0.01)
    assert_random_goals(q[:, 19:])
    goals = np.asarray(jax.jit(jax.vmap(tasks.make(NAME).start))(jax.random.split(jax.random.key(1), 4096))[1])
    assert_random_goals(goals)
    assert np.abs(np.mean(goals[:, 1:] * q[:, 20:], axis=0)).max() < 0.02  # independent of the cube


def assert_random_goals(goal):
    """Turns about y, then about x, by any angles."""
    matrix = rotation(goal).as_matrix()
    x, y = np.arctan2(matrix[:, 2, 1], matrix[:, 1, 1]), np.arctan2(matrix[:, 0, 2], matrix[:, 0, 0])
    expected = Rotation.from_euler("x", x[:, None]) * Rotation.from_euler("y", y[:, None])
    np.testing.assert_allclose(matrix, expected.as_matrix(), atol=1e-5)
    tasks.assert_uniform(np.stack([x, y], axis=1), 0.0, np.pi)


# --- Steps ------------------------------------------------------------------------------------------------------------


def test_a_reached_goal_is_replaced_and_no_other():
    """In its own environment, by a draw of its own; the reward is that of the old goal, the observation shows the new."""
    first = tasks.start(NAME)
    bodies = first.physics.rigid
    lifted = bodies.replace(qpos=bodies.qpos.at[:, 18].add(0.06))  # above the fingers, where nothing turns it
    first = first.replace(physics=first.physics.replace(rigid=lifted))
    orientation = lifted.qpos[:, 19:]
    reached = np.array([True, False, True, False, False, True, False, True])
    at = jnp.where(reached[:, None], orientation, first.physics.task)
    state = first.replace(physics=first.physics.replace(task=at))
    after = tasks.step(NAME)(state, jnp.zeros((8, 16)))
    np.testing.assert_array_equal(after.metrics["reached"], reached)
    goal = np.asarray(after.physics.task)
    np.testing.assert_array_equal(goal[~reached], np.asarray(first.physics.task)[~reached])
    assert np.abs(goal - np.asarray(at))[reached].max(axis=1).min() > 1e-2
    assert np.abs(goal[reached][:, None] - goal[reached][None])[~np.eye(4, dtype=bool)].max(axis=1).min() > 1e-2
    np.testing.assert_allclose(np.linalg.norm(goal, axis=1), 1.0, rtol=1e-5)
    np.testing.assert_array_equal(after.obs["state"][:, 48:52], xyzw(goal))
    assert np.asarray(after.reward)[reached].min() > 120.0 and np.asarray(after.reward)[~reached].max() < 12.0
    # What one environment draws does not depend on what happens in the others.
    alone = jnp.where((np.arange(8) == 2)[:, None], orientation, first.physics.task)
    other = tasks.step(NAME)(first.replace(physics=first.physics.replace(task=alone)), jnp.zeros((8, 16)))
    np.testing.assert_array_equal(other.physics.task[2], goal[2])
    # Nor does a second draw repeat the first.
    again = after.replace(physics=after.physics.replace(task=after.physics.rigid.qpos[:, 19:]))
    second = tasks.step(NAME)(again, jnp.zeros((8, 16)))
    assert np.abs(np.asarray(second.physics.task) - goal).max(axis=1).min() > 1e-2


# --- Gradients --------------------------------------------------------------------------------------------------------


@functools.cache
def near(num):
    """States in which the cube falls onto the fingers, random ones of the hand."""
    rng = np.random.default_rng(8)
    q, v = tasks.starts(NAME, num)
    q, v = q.copy(), v.copy()
    q[:, 18] -= rng.uniform(0.03, 0.07, num)
    q[:, 17] += rng.uniform(-0.02, 0.05, num)
    v[:, 18] = rng.uniform(-0.6, 0.0, num)
    v[:, :16] = rng.uniform(-1.0, 1.0, (num, 16))
    return q, v, rng.uniform(-0.9, 0.9, (num, 8, 16))


def returns(env, actions, q, v, key):
    state = env.reset(key)
    bodies = rigid.initial_state(env.model, q, v)
    state = state.replace(physics=state.physics.replace(rigid=bodies))

    def body(state, action):
        state = env.step(state, action)
        return state, state.reward + jnp.sum(state.obs["state"][32:39])

    return jnp.sum(jax.lax.scan(body, state, actions)[1])


def test_gradients_are_finite_from_any_start():
    """Over eight steps, while the cube meets the fingers."""
    env, (q, v, actions) = tasks.make(NAME), near(64)
    keys = jax.random.split(jax.random.key(9), 64)
    gradient = jax.jit(jax.vmap(jax.grad(lambda *x: returns(env, *x))))(*map(jnp.float32, (actions, q, v)), keys)
    size = np.linalg.norm(np.asarray(gradient).reshape(64, -1), axis=1)
    print(np.sort(size))
    assert np.isfinite(gradient).all() and size.min() > 1e-3


@pytest.mark.slow
def test_gradients_are_those_of_finite_differences():
    starts = near(64)
    with jax.enable_x64(True):
        env, keys = rewax.make(NAME, scale="small"), jax.random.split(jax.random.key(9), 16)
        q, v, actions = (jnp.asarray(a[:16], jnp.float64) for a in starts)
        actions, h = actions[:, :3], 1e-6
        f = jax.jit(jax.vmap(lambda *x: returns(env, *x)))
        gradient = jax.jit(jax.vmap(jax.grad(lambda *x: returns(env, *x))))(actions, q, v, keys)
        direction = jax.random.normal(jax.random.key(10), actions.shape)
        expected = (f(actions + h * direction, q, v, keys) - f(actions - h * direction, q, v, keys)) / (2 * h)
        found = np.sum(np.asarray(gradient * direction), axis=(1, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-4)
