"""Records of a task: what the camera sees is the body's surface, with the asked noise and occlusion; files keep all."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewax
from rewax.envs.history import History
from rewax.envs.randomize import Uniform, hook
from rewax.envs.randomized import Randomized
from rewax.identify import load, record, record_states, save
from rewax.identify.recording import camera_for, soft_labels
from rewax.identify.records import camera_numbers, camera_of
from rewax.identify.simulate import drawn_once, regions, without_reset_noise
from rewax.sensors import Camera
from rewax.sensors.noise import DepthNoise

ACTIONS = np.tile(np.float32([0.3, -1.0, 0.0]), (3, 1))


@pytest.fixture(scope="module")
def env():
    return rewax.make("RollingFlat", scale="small")


@pytest.fixture(scope="module")
def seen(env):
    return record(env, ACTIONS, jax.random.key(0))


def test_points_lie_on_the_balls_of_the_particles(env, seen):
    assert seen.num_frames == 4 and seen.mask.all() and seen.clouds.shape == (4, 256, 3)
    np.testing.assert_allclose(seen.times, env.control_dt * np.arange(4))
    rest = np.asarray(env.rest_positions)  # the reset noise is left out
    gap = np.linalg.norm(seen.clouds[0][:, None] - rest[None], axis=-1).min(1)
    np.testing.assert_allclose(gap, 0.4 * env.scene.grid.spacing, atol=1e-3)
    np.testing.assert_allclose(seen.joint_q[1] - seen.joint_q[0], [0.006, -0.004, 0.0], atol=1e-6)


def test_noise_has_its_size_and_occlusion_hides_its_share(env, seen):
    camera = camera_for(np.asarray(env.rest_positions), np.asarray(env.up))
    hidden = record(env, ACTIONS, jax.random.key(0), occlusion=0.3, camera=camera, num_points=4096)
    whole = record(env, ACTIONS, jax.random.key(0), camera=camera, num_points=4096)
    share = 1.0 - hidden.mask.sum(1) / whole.mask.sum(1)
    np.testing.assert_allclose(share, 0.3, atol=0.03)
    noisy = record(env, ACTIONS[:1], jax.random.key(0), noise=0.002, camera=camera, num_points=4096)
    difference = noisy.clouds[0][noisy.mask[0]] - whole.clouds[0][whole.mask[0]]
    along = difference @ np.asarray(camera.rotation)[:, 2]
    assert along.std() == pytest.approx(0.002, rel=0.1)
    grainy = camera.replace(noise=DepthNoise(constant=0.002))  # noise of the camera itself
    own = record(env, ACTIONS[:1], jax.random.key(0), camera=grainy, num_points=4096)
    np.testing.assert_array_equal(own.clouds, noisy.clouds)
    with pytest.raises(ValueError, match=r"noise is 0.002, and the camera has noise of its own: give one of them"):
        record(env, ACTIONS[:1], jax.random.key(0), noise=0.002, camera=grainy)


def test_a_record_keeps_what_a_zoomed_camera_sees():
    camera = Camera.look_at((0.0, 0.0, 0.0), eye=(0.0, 0.6, 0.6), height=8, width=12).replace(zoom=jnp.float32(1.3))
    depth = jnp.full((8, 12), 1.0)
    found = camera_of(camera_numbers(camera)).points(depth)
    np.testing.assert_allclose(found, camera.points(depth), atol=1e-6)
    assert np.abs(found - camera.replace(zoom=None).points(depth)).max() > 0.05


def test_a_record_is_the_same_every_time_and_survives_its_file(env, seen, tmp_path):
    again = record(env, ACTIONS, jax.random.key(0))
    np.testing.assert_array_equal(again.clouds, seen.clouds)
    read = load(save(seen, tmp_path / "a.npz"))
    for name in ("times", "clouds", "mask", "actions", "joint_q", "camera"):
        np.testing.assert_array_equal(getattr(read, name), getattr(seen, name))
    assert read.control_dt == seen.control_dt and '"env": "RollingFlat"' in read.source
    camera = camera_of(read.camera, near=0.1, far=2.0)
    assert (camera.height, camera.width, camera.field_of_view) == (64, 64, 32.0)
    assert save(seen, tmp_path / "push_E0.5") == tmp_path / "push_E0.5.npz"


def test_a_policy_may_move_the_tool_and_frames_may_be_rarer(env):
    seen = record(env, lambda state, key: state.obs["joint_q"] * 0 - 1.0, jax.random.key(0), num_steps=4, every=2)
    np.testing.assert_array_equal(seen.actions, -np.ones((4, 3)))
    np.testing.assert_allclose(seen.times, env.control_dt * np.array([0, 2, 4]))
    part = seen.first(env.control_dt * 2.5)
    assert part.num_frames == 2 and len(part.actions) == 2 and len(part.joint_q) == 3


def test_states_that_are_known_give_the_record_of_their_episode(env, seen):
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(5))
    at_rest = state.physics.soft.replace(x=env.rest_positions)
    states = [state.replace(physics=state.physics.replace(soft=at_rest))]
    for action in ACTIONS:
        states.append(step(states[-1], action))
    same = record_states(env, [s.physics for s in states], ACTIONS, jax.random.key(0))
    for name in ("times", "clouds", "mask", "actions", "joint_q", "camera"):
        np.testing.assert_allclose(getattr(same, name), getattr(seen, name), atol=1e-6)
    with pytest.raises(ValueError, match="there are 3 states with 3 actions"):
        record_states(env, [s.physics for s in states[1:]], ACTIONS, jax.random.key(0))


def test_a_world_that_is_drawn_is_drawn_once(env):
    modulus = "scene.material.elasticity.youngs_modulus"
    softer = Randomized(env=env, randomize=hook({modulus: Uniform(400.0, 500.0)}))
    assert drawn_once(env, jax.random.key(0)) is env
    one, other = (drawn_once(History(env=softer, steps=2), jax.random.key(seed)).env for seed in (0, 1))
    moduli = [float(drawn.scene.material.elasticity.youngs_modulus) for drawn in (one, other)]
    assert moduli[0] != moduli[1] and all(400.0 <= value <= 500.0 for value in moduli)
    again, first = (record(softer, ACTIONS, jax.random.key(3)) for _ in range(2))
    np.testing.assert_array_equal(again.clouds, first.clouds)


def test_bad_options_and_failed_steps_are_told(env):
    with pytest.raises(ValueError, match="occlusion is 1"):
        record(env, ACTIONS, jax.random.key(0), occlusion=1.0)
    carried = camera_for(np.asarray(env.rest_positions), np.asarray(env.up)).replace(body=0)
    with pytest.raises(ValueError, match=r"body 0 carries the camera.* give a camera with body=None"):
        record(env, ACTIONS, jax.random.key(0), camera=carried)
    stiff = rewax.replace_leaf(env, "scene.material.elasticity.youngs_modulus", 1e6)
    with pytest.raises(ValueError, match=r"step 0 of the record has status .*INVALID_PARAMETERS"):
        record(stiff, ACTIONS, jax.random.key(0))


def test_regions_have_about_equally_many_points(seen):
    counts = np.bincount(regions(seen.clouds, seen.mask, 4).reshape(-1), minlength=16)
    assert counts.sum() == seen.mask.sum() and np.sort(counts)[4] > 0.3 * counts.mean()


def test_a_body_of_the_robot_may_be_called_as_the_soft_one():
    assert soft_labels(("dough", "floor", "world", "dough_2", "hand"), ["world", "dough", "hand"]) == [0]
    assert soft_labels(("dough", "tool", "floor", "floor_2"), ["floor"]) == [0]


def test_a_robot_is_no_part_of_the_body_that_is_recorded():
    env = rewax.make("GripperLift", scale="small")
    state = jax.jit(without_reset_noise(env).reset)(jax.random.key(0))
    low, high = (end(np.asarray(env.particles(state.physics)), axis=0) for end in (np.min, np.max))
    camera = camera_for(np.asarray(env.particles(state.physics)), np.asarray(env.up)).replace(field_of_view=90.0)
    world = jax.jit(lambda physics: camera.view(env.world(physics, env_up)).label)
    env_up = np.asarray(env.up)
    assert len(np.unique(np.asarray(world(state.physics)))) > 3  # fingers, floor and nothing are in the picture, too
    seen = record_states(env, [state.physics], np.zeros((0, 4)), jax.random.key(0), camera=camera)
    cloud, margin = seen.clouds[0][seen.mask[0]], float(env.scene.grid.spacing)
    assert len(cloud) > 8 and np.all((cloud > low - margin) & (cloud < high + margin))
