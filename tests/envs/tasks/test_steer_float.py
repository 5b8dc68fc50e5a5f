"""SteerFloat: what floats, what the paddle moves with and without touching it, the reward, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import soft_tasks
from soft_tasks import difference_errors, make

from rewax.envs.tasks import steer_float
from rewax.physics import mpm

ENV = make("SteerFloat")
FLOAT = slice(0, ENV.float_count)


def middle(state):
    return np.asarray(state.physics.soft.x[FLOAT].mean(0))


@pytest.mark.parametrize("scale", ["paper", "small"])
def test_float_and_water_fill_the_basin_without_overlap(scale):
    env = make("SteerFloat", scale)
    x = np.asarray(env.rest_positions)
    solid, pool = x[: env.float_count], x[env.float_count :]
    np.testing.assert_allclose(solid.mean(0), steer_float.FLOAT_START, atol=1e-5)
    mass = np.asarray(mpm.particle_mass(env.scene, env.rest_positions))
    assert mass[: env.float_count].sum() == pytest.approx(400.0 * 0.075 * 0.05 * 0.075, rel=1e-4)
    half = 0.5 * np.asarray(steer_float.FLOAT_SIZE)
    assert (np.abs(pool - steer_float.FLOAT_START) > half).any(1).all()
    paddle = np.asarray(env.poses(jnp.asarray(env.joint_start)[None]).position)[0, 0]
    assert (np.abs(pool - paddle) > np.asarray(steer_float.PADDLE)).any(1).all()
    assert env.scene.particle_counts == (env.float_count, len(pool))


@pytest.mark.parametrize("scale", ["paper", "small"])
def test_no_node_lies_on_a_face_of_the_paddle_or_midway_between_two(scale):
    """There a node's velocity would jump with the paddle, and the derivative at the start would miss it."""
    env = make("SteerFloat", scale)
    grid = env.scene.grid
    nodes = grid.spacing * np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    local = np.abs(nodes - np.asarray(env.poses(jnp.asarray(env.joint_start)[None]).position)[0, 0])
    to_faces = np.concatenate([steer_float.PADDLE - local, steer_float.PADDLE + local], axis=-1)
    nearest = np.sort(to_faces[to_faces.min(axis=-1) > -0.5 * grid.spacing], axis=-1)
    assert len(nearest) > 50
    assert np.abs(nearest[:, 0]).min() > 0.02 * grid.spacing
    assert (nearest[:, 1] - nearest[:, 0]).min() > 0.02 * grid.spacing


def test_the_derivative_by_the_start_of_the_joints_is_that_of_differences(x64):
    env = steer_float.small()
    action, along = jnp.array([0.3, 0.2, -0.1]), jnp.array([0.1, 0.2, 0.3])

    def reward(size):
        moved = env.replace(joint_start=jnp.asarray(env.joint_start) + size * along)
        return moved.step(moved.reset(jax.random.key(0)), action).reward

    derivative = jax.jit(lambda: jax.jvp(reward, (0.0,), (1.0,))[1])()
    after, before = jax.jit(jax.vmap(reward))(jnp.array([1e-6, -1e-6]))
    np.testing.assert_allclose((after - before) / 2e-6, derivative, rtol=1e-5)


def test_the_float_floats():
    """Left alone it stays where it is, and displaces its own weight of water: 40 % of its height."""
    end = soft_tasks.run("SteerFloat", soft_tasks.start("SteerFloat"), 0.0, 60)[-1]
    moved = middle(end) - steer_float.FLOAT_START
    assert np.abs(moved[[0, 2]]).max() < 0.015
    x = np.asarray(end.physics.soft.x)
    surface = np.quantile(x[ENV.float_count :, 1], 0.98)
    immersed = (surface - x[FLOAT, 1].min()) / np.ptp(x[FLOAT, 1])
    assert 0.2 < immersed < 0.7
    assert int(end.status) == 0


def test_the_paddle_moves_the_float_before_it_touches():
    start, clear = soft_tasks.start("SteerFloat"), True
    for state in soft_tasks.run("SteerFloat", start, jnp.array([0.5, 0.0, 0.0]), 8):
        ahead = np.asarray(state.physics.soft.x[FLOAT, 0]).min() - float(state.physics.joint_q[0])
        clear &= ahead > steer_float.PADDLE[0] + 0.5 * ENV.scene.grid.spacing
    assert clear
    assert middle(state)[0] > steer_float.FLOAT_START[0] + 0.003


def test_the_mark_is_drawn_ahead():
    marks = np.asarray(jax.jit(jax.vmap(ENV.reset))(jax.random.split(jax.random.key(0), 512)).physics.task)
    shift = marks - [steer_float.FLOAT_START[0], steer_float.FLOAT_START[2]]
    for values, low, high in zip(shift.T, (0.06, -0.05), (0.14, 0.05), strict=True):
        assert low - 1e-6 <= values.min() < low + 0.002 and high - 0.002 < values.max() <= high + 1e-6
        assert values.mean() == pytest.approx(0.5 * (low + high), abs=0.005)


def test_reward_is_the_formula():
    x = np.asarray(ENV.rest_positions, np.float64)
    state = soft_tasks.physics(ENV, x, task=jnp.array([0.26, 0.23]))
    reward, metrics = ENV.reward(state)
    np.testing.assert_allclose(reward, 1.0 - (0.06**2 + 0.03**2) / 0.1**2, atol=1e-6)
    assert float(metrics["success"]) == 0.0
    near = soft_tasks.physics(ENV, x, task=jnp.array([0.21, 0.21]))
    assert float(ENV.reward(near)[1]["success"]) == 1.0


def test_observations_are_seen_from_the_float():
    state = soft_tasks.run("SteerFloat", soft_tasks.start("SteerFloat"), jnp.array([1.0, 0.0, 0.5]), 3)[-1]
    x, at = np.asarray(state.physics.soft.x), middle(state)
    np.testing.assert_allclose(state.obs["particle_q"], x[::20][:64] - at, atol=1e-6)
    vector = np.asarray(state.obs["vector"])
    np.testing.assert_allclose(vector[:3], at, atol=1e-6)
    np.testing.assert_allclose(vector[6:8], np.asarray(state.physics.joint_q)[:2] - at[[0, 2]], atol=1e-6)
    np.testing.assert_allclose(vector[8:14], [*state.physics.joint_q, 1.0, 0.0, 0.5], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(vector[14:], np.asarray(state.physics.task) - at[[0, 2]], atol=1e-6)


@pytest.mark.slow
def test_gradient_by_actions_is_that_of_differences(x64):
    """The paddle at the float, three substeps a step; through both materials."""
    env = steer_float.small()
    env = env.replace(num_substeps=3, list_every=None, joint_start=jnp.array([0.14, 0.2, 0.1]))
    errors = difference_errors(env, num_steps=4, scale=0.9, h=1e-6)
    assert errors[:, 0].max() < 1e-9 and errors[:, 1].max() < 1e-4


def test_a_cloud_with_velocities_has_the_positions_of_the_cloud_without():
    physics = soft_tasks.run("SteerFloat", soft_tasks.start("SteerFloat"), jnp.array([1.0, 0.0, 0.5]), 3)[-1].physics
    points, moving = ENV.observe(physics)["particle_q"], ENV.cloud.replace(velocities=True)
    np.testing.assert_array_equal(
        moving.shown({"particle_q": points}, ENV.points(physics), None)[0]["particle_q"][:, :3], points
    )


@pytest.mark.parametrize("scale", ["paper", "small"])
def test_rounding_does_not_decide_how_much_water_there_is(scale):
    with jax.enable_x64(True):
        precise = steer_float.small() if scale == "small" else steer_float.paper()
    assert precise.scene.particle_counts == make("SteerFloat", scale).scene.particle_counts
