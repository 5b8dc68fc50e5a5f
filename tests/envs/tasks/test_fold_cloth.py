"""FoldCloth: the reward of a flat and of a folded towel, wrinkles, and hands that fold it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import soft_tasks
from soft_tasks import make

from rewax.envs.tasks.fold_cloth import EDGE, RADIUS

ENV = make("FoldCloth")
START = soft_tasks.start("FoldCloth")
FLAT = np.asarray(ENV.rest_positions, np.float64)


def folded():
    """The half with the hands on the other one, one thickness above it."""
    x = FLAT.copy()
    x[:, 0] = -np.abs(x[:, 0])
    x[len(x) // 2 + ENV.cells // 2 + 1 :, 1] += RADIUS
    return x


def reward(x):
    value, metrics = ENV.reward(soft_tasks.physics(ENV, x))
    return float(value), {name: float(number) for name, number in metrics.items()}


def test_a_flat_towel_earns_minus_a_half_and_a_folded_one_nearly_1():
    value, metrics = reward(FLAT)
    pairs = np.linspace(EDGE, 0.0, ENV.cells // 2, endpoint=False)  # distances of mirror images
    assert metrics["gap"] == pytest.approx(pairs.mean(), rel=1e-3) and metrics["success"] == 0.0
    assert value == pytest.approx(-0.5, abs=1e-3)
    assert metrics["area"] == pytest.approx(0.0, abs=1e-5)  # the mean of both halves is a line
    value, metrics = reward(folded())
    assert 0.9 < value < 1.0 and metrics["success"] == 1.0 and metrics["area"] == pytest.approx(1.0, abs=0.01)


def test_a_crumpled_towel_earns_less_than_a_folded_one():
    heap = 0.3 * folded() + [0.0, 0.05, 0.0]
    assert reward(heap)[0] < reward(folded())[0] - 0.4 and reward(heap)[1]["success"] == 0.0


def test_starts_differ_in_place_and_wrinkles():
    physics = jax.jit(jax.vmap(ENV.reset))(jax.random.split(jax.random.key(0), 32)).physics
    height = np.asarray(physics.soft.x[..., 1]) - RADIUS
    assert height.min() >= -1e-6 and 0.005 < height.max() < 0.05 and np.std(height.mean(axis=1)) > 1e-3
    level = np.asarray(physics.soft.x)[..., [0, 2]] - FLAT[:, [0, 2]]
    assert np.abs(level).max() <= 0.03 + 1e-5 and np.std(level[:, 0], axis=0).min() > 0.01
    corners = np.asarray(physics.soft.x)[:, list(ENV.corners)].reshape(32, 6)
    np.testing.assert_allclose(np.asarray(physics.joint_q)[:, :6], corners, atol=1e-6)


def test_hands_that_move_in_a_half_circle_fold_it():
    state = START
    for _ in range(50):
        q = np.asarray(state.physics.joint_q)
        height = 0.02 + 0.9 * max(0.0, 0.2**2 - q[0] ** 2) ** 0.5
        along = -0.7 if q[0] > -0.19 else 0.0
        up = np.clip((height - q[1]) / 0.025, -1.0, 1.0)
        action = [along, up, 0.0, along, up, 0.0, 0.0 if along else -1.0]
        state = soft_tasks.run("FoldCloth", state, jnp.array(action), 1)[-1]
    assert float(state.reward) > 0.4 and float(state.metrics["gap"]) < 0.12 and int(state.truncated) == 1
