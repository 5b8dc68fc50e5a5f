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
    task = whip_rope.Aim(target=jnp.asarray(target), nearest=jnp.float32(nearest))
    return soft_tasks.physics(ENV, x, task=task)


def test_the_rope_hangs_from_the_hand_and_stays():
    end = soft_tasks.run("WhipRope", START, 0.0, 48)[-1]
    np.testing.assert_allclose(end.physics.soft.x[0], HAND, atol=1e-6)
    np.testing.assert_allclose(end.physics.soft.x[-1], np.array(HAND) - [0.0, LENGTH, 0.0], atol=5e-3)
    assert int(end.status) == 0 and float(end.metrics["success"]) == 0.0
    assert make("WhipRope", "paper").control_dt == pytest.approx(ENV.control_dt)


def test_the_hand_moves_as_told_and_the_rope_follows():
    states = soft_tasks.run("WhipRope", START, jnp.array([1.0, 0.0, 0.0]), 24)
    np.testing.assert_allclose(states[2].physics.soft.x[0], np.array(HAND) + [0.18, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(states[2].physics.soft.v[0], [2.4, 0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(states[-1].physics.soft.x[0], np.array(HAND) + [0.25, 0.0, 0.0], atol=1e-6)  # the limit
    ends = [float(state.physics.soft.x[-1, 0]) for state in states]
    assert abs(ends[3]) < 0.01 and max(ends) > 0.2  # the wave takes half a second to the free end
    lengths = np.linalg.norm(np.diff(np.asarray(states[-1].physics.soft.x), axis=0), axis=-1)
    assert lengths.sum() == pytest.approx(LENGTH, rel=0.1)


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


def test_reward_is_the_way_gained():
    target = np.array([0.5, 1.0, 0.0])
    reward, metrics = ENV.reward(physics(target + [0.0, 0.3, 0.4], target, 0.8))
    np.testing.assert_allclose(reward, (0.8 - np.hypot(0.5, 0.01)) / 0.1, rtol=1e-5)
    assert float(metrics["success"]) == 0.0
    away = physics(target + [0.0, 0.3, 0.4], target, 0.04)
    assert float(ENV.reward(away)[0]) == 0.0 and float(ENV.reward(away)[1]["success"]) == 1.0  # it hit before
    near = physics(target + [0.02, 0.0, 0.0], target, 0.8)
    np.testing.assert_allclose(ENV.next_task(near, None).nearest, np.hypot(0.02, 0.01), rtol=1e-5)
    np.testing.assert_allclose(ENV.next_task(away, None).nearest, 0.04)


def test_the_return_is_the_least_distance():
    states = soft_tasks.run("WhipRope", START, jnp.array([1.0, 0.5, 0.2]), 12)
    total = sum(float(state.reward) for state in states)
    nearest = min(float(state.metrics["distance"]) for state in states)
    np.testing.assert_allclose(total, (float(START.physics.task.nearest) - nearest) / 0.1, rtol=1e-4)
    assert total > 0.1


def test_gradient_by_actions_is_that_of_differences(x64):
    """The target is above the hand, so that the free end comes nearer within a few steps."""
    env = whip_rope.small().replace(elevation=jnp.array([1.2, 1.3]))
    errors = difference_errors(env, num_steps=6, scale=0.9, directions=1, h=1e-6)
    assert errors[:, 0].max() < 1e-9 and errors[:, 1].max() < 1e-5
