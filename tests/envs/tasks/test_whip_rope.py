"""WhipRope: the rope hangs, follows the hand, and earns what its end comes nearer to the target."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import soft_tasks
from soft_tasks import difference_errors, make

from rewax.envs.tasks import whip_rope
from rewax.envs.tasks.whip_rope import HAND, LENGTH

ENV = make("WhipRope")
START = soft_tasks.start("WhipRope")


def physics(tip, target, nearest):
    x = np.asarray(ENV.rest_positions).copy()
    x[-1] = tip
    task = whip_rope.Aim(target=jnp.asarray(target), nearest=jnp.float32(nearest), soft_nearest=jnp.float32(nearest))
    return soft_tasks.physics(ENV, x, task=task)


def test_the_rope_hangs_from_the_hand_and_stays():
    end = soft_tasks.run("WhipRope", START, 0.0, 32)[-1]
    np.testing.assert_allclose(end.physics.soft.x[0], HAND, atol=1e-6)
    np.testing.assert_allclose(end.physics.soft.x[-1], np.array(HAND) - [0.0, LENGTH, 0.0], atol=5e-3)
    assert int(end.status) == 0 and float(end.metrics["success"]) == 0.0
    assert make("WhipRope", "paper").control_dt == pytest.approx(ENV.control_dt)


def test_the_hand_approaches_its_set_point_and_the_rope_follows():
    """A critically damped oscillator from rest: the distance left is (1 + w t) exp(-w t)."""
    states = soft_tasks.run("WhipRope", START, jnp.array([1.0, 0.0, -0.5]), 24)
    for i in (0, 4, 23):
        turn = 10.0 * 0.05 * (i + 1)
        gone = 1.0 - (1.0 + turn) * np.exp(-turn)
        np.testing.assert_allclose(
            states[i].physics.soft.x[0] - np.array(HAND), [0.3 * gone, 0.0, -0.15 * gone], atol=1e-5
        )
        speed = 0.3 * 10.0 * turn * np.exp(-turn)
        np.testing.assert_allclose(states[i].physics.joint_qd, [speed, 0.0, -0.5 * speed], atol=1e-5)
        np.testing.assert_allclose(states[i].physics.soft.v[0], states[i].physics.joint_qd, atol=0.02)
    ends = [float(state.physics.soft.x[-1, 0]) for state in states]
    assert abs(ends[0]) < 0.02 and max(ends) > 0.3
    lengths = np.linalg.norm(np.diff(np.asarray(states[-1].physics.soft.x), axis=0), axis=-1)
    assert lengths.sum() == pytest.approx(LENGTH, rel=0.05)


def test_targets_are_drawn_within_their_range():
    task = jax.jit(jax.vmap(ENV.reset))(jax.random.split(jax.random.key(0), 512)).physics.task
    shift = np.asarray(task.target) - HAND
    away = np.linalg.norm(shift, axis=-1)
    found = (away, np.arctan2(shift[:, 2], shift[:, 0]), np.arcsin(shift[:, 1] / away))
    for values, name in zip(found, ("distance", "azimuth", "elevation"), strict=True):
        low, high = np.asarray(getattr(ENV, name))
        margin = 0.02 * (high - low)
        assert low - 1e-4 <= values.min() < low + margin and high - margin < values.max() <= high + 1e-4
    tip = np.asarray(ENV.rest_positions)[-1]
    np.testing.assert_allclose(task.nearest, np.linalg.norm(np.asarray(task.target) - tip, axis=-1), atol=1e-3)


def test_reward_is_how_much_nearer_the_end_came():
    target = np.array([0.5, 1.0, 0.0])
    distance = np.hypot(0.5, 0.01)
    reward, metrics = ENV.reward(physics(target + [0.0, 0.3, 0.4], target, 0.8))
    np.testing.assert_allclose(reward, (0.8 - distance) / 0.1, rtol=1e-3)  # much nearer: the minimum is the new one
    assert float(metrics["success"]) == 0.0
    same = physics(target + [0.0, 0.3, 0.4], target, distance)
    np.testing.assert_allclose(ENV.reward(same)[0], 0.03 * np.log(2.0) / 0.1, rtol=1e-4)
    away = physics(target + [0.0, 0.3, 0.4], target, 0.04)
    assert float(ENV.reward(away)[0]) < 1e-4 and float(ENV.reward(away)[1]["success"]) == 1.0  # it hit before
    near = physics(target + [0.02, 0.0, 0.0], target, 0.8)
    np.testing.assert_allclose(ENV.next_task(near, None).nearest, np.hypot(0.02, 0.01), rtol=1e-5)
    np.testing.assert_allclose(ENV.next_task(away, None).nearest, 0.04)


def test_the_return_is_a_smooth_least_distance():
    states = soft_tasks.run("WhipRope", START, jnp.array([1.0, 0.5, 0.2]), 32)
    total, first = sum(float(state.reward) for state in states), float(START.physics.task.nearest)
    distances = np.array([first, *(float(state.metrics["distance"]) for state in states)])
    wanted = first + 0.03 * np.log(np.exp(-distances / 0.03).sum())
    np.testing.assert_allclose(total, wanted / 0.1, rtol=1e-3)
    assert total > 1.0 and int(states[-1].truncated) == 1


def test_gradient_by_actions_is_that_of_differences(x64):
    errors = difference_errors(whip_rope.small(), num_steps=4, scale=0.9, directions=1, h=1e-6)
    assert errors[:, 0].max() < 1e-9 and errors[:, 1].max() < 1e-5


def test_a_cloud_with_velocities_has_the_positions_of_the_cloud_without():
    physics = START.physics
    points, moving = ENV.observe(physics)["particle_q"], ENV.cloud.replace(velocities=True)
    np.testing.assert_array_equal(
        moving.shown({"particle_q": points}, ENV.points(physics), None)[0]["particle_q"][:, :3], points
    )
