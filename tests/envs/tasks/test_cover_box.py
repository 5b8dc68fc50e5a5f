"""CoverBox: the spots lie on the box, the reward is the formula, and hands that carry the cloth over the box cover it."""

import jax.numpy as jnp
import numpy as np
import pytest
import soft_tasks
from soft_tasks import make

from rewax.envs.tasks.cover_box import HALF_SIZE, spots_of_box

ENV = make("CoverBox")
START = soft_tasks.start("CoverBox")


def test_spots_lie_on_the_five_open_faces():
    spots = spots_of_box(HALF_SIZE, 0.05)
    away = np.abs(spots - [0.0, HALF_SIZE[1], 0.0]) / HALF_SIZE
    np.testing.assert_allclose(away.max(axis=1), 1.0)
    assert (spots[:, 1] > 0.0).all() and len(np.unique(spots.round(6), axis=0)) == len(spots) == 16 + 4 * 12
    np.testing.assert_allclose(spots.mean(axis=0)[[0, 2]], 0.0, atol=1e-12)


def test_reward_is_the_formula():
    rng = np.random.default_rng(0)
    x = np.asarray(ENV.rest_positions) + rng.normal(size=ENV.rest_positions.shape) * 0.1 + [0.3, -0.2, 0.0]
    spots, near, softness = (np.asarray(a, np.float64) for a in (ENV.spots, ENV.near, ENV.softness))
    distance = np.linalg.norm(spots[:, None] - x, axis=-1).min(axis=1)
    beyond = np.maximum(distance - near, 0.0) / softness
    reward, metrics = ENV.reward(soft_tasks.physics(ENV, x))
    np.testing.assert_allclose(reward, np.mean(1.0 / (1.0 + beyond**2)), rtol=1e-3)
    np.testing.assert_allclose(metrics["covered"], np.mean(distance <= near), atol=0.02)
    on_top = np.repeat(spots, 2, axis=0)[: len(x)]
    assert float(ENV.reward(soft_tasks.physics(ENV, on_top))[0]) > 0.9


def test_cloth_and_hands_start_together_beside_the_box():
    q = np.asarray(START.physics.joint_q)
    np.testing.assert_allclose(q[:6].reshape(2, 3), np.asarray(START.physics.soft.x)[list(ENV.corners)], atol=1e-6)
    assert q[6] == 1.0 and float(START.physics.soft.x[:, 0].max()) < -HALF_SIZE[0]
    shift = np.asarray(START.physics.soft.x - ENV.rest_positions)
    assert np.ptp(shift, axis=0).max() < 1e-5 and np.abs(shift).max() > 1e-3
    assert make("CoverBox", "paper").control_dt == pytest.approx(ENV.control_dt)


def test_a_cloth_that_is_carried_over_the_box_covers_it():
    over, down, wait = ([0.9, -0.15, 0.0] * 2 + [0.0], [0.2, -0.9, 0.0] * 2 + [0.0], [0.0] * 6 + [-1.0])
    state, rewards = START, []
    for actions, num in ((over, 22), (down, 8), (wait, 30)):
        states = soft_tasks.run("CoverBox", state, jnp.array(actions), num)
        state, rewards = states[-1], rewards + [float(s.reward) for s in states]
        assert int(state.status) == 0
    assert rewards[0] < 0.1 and np.mean(rewards[-10:]) > 0.7 and int(state.truncated) == 1
    distance = np.asarray(state.physics.soft.x)
    inside = (np.abs(distance - [0.0, HALF_SIZE[1], 0.0]) < np.array(HALF_SIZE) - 0.01).all(axis=1)
    assert not inside.any()
