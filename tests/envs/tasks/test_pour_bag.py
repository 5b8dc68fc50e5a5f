"""PourBag: the reward, hands that hold the bag, grains that stay in it, and a pour into the bowl."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import soft_tasks
from soft_tasks import make

from rewax.envs.tasks import pour_bag
from rewax.physics import mpm

ENV = make("PourBag")
START = soft_tasks.start("PourBag")
POUR_AT = -0.05
"""x of the hands [m] from where grains fall into the bowl."""
HELD = ENV.thin_scene.topology.held.indices[:, 0]


def reward_of_grains(x):
    """Reward and metrics if all grains are at one place relative to the middle of the bowl's rim."""
    grains = np.broadcast_to(np.asarray(ENV.bowl) + x, (ENV.num_particles, 3))
    points = np.concatenate([grains, np.asarray(ENV.rest_positions)[ENV.num_particles :]])
    value, metrics = ENV.reward(soft_tasks.physics(ENV, points))
    return float(value), {name: float(number) for name, number in metrics.items()}


def test_the_reward_is_the_formula():
    value, metrics = reward_of_grains([0.05, -0.06, 0.0])
    assert value == pytest.approx(1.0, abs=1e-3) and metrics["inside"] == metrics["success"] == 1.0
    value, metrics = reward_of_grains([0.0, -0.1, 0.25])  # on the floor beside the bowl
    assert value == pytest.approx(-0.5, abs=1e-3) and metrics["spilled"] == pytest.approx(1.0, abs=1e-3)
    for x, distance in (([0.0, 0.15, 0.0], 0.15), ([-0.2675, 0.0, 0.0], 0.15), ([0.0, 0.12, -0.2075], 0.15)):
        away = [x[0], x[1] + 0.05, x[2]]  # well above the rim, where nothing counts as spilled
        further = np.hypot(max(np.hypot(x[0], x[2]) - float(ENV.rim), 0.0), away[1])
        value, metrics = reward_of_grains(away)
        assert value == pytest.approx(1.0 / (1.0 + (further / 0.15) ** 2), rel=0.02) and metrics["inside"] == 0.0
        assert np.hypot(max(np.hypot(x[0], x[2]) - float(ENV.rim), 0.0), x[1]) == pytest.approx(distance, abs=1e-6)


def test_the_hands_hold_two_edges_and_turn_about_their_middle():
    q = np.asarray(START.physics.joint_q)
    pins = np.asarray(ENV.pins(START.physics, jnp.asarray(q)[None]))[0]
    np.testing.assert_allclose(pins, np.asarray(START.physics.soft.thin.x)[HELD], atol=1e-6)
    turned = q + [0.1, 0.05, -0.02, -0.04, 0.5 * np.pi]
    pins = np.asarray(ENV.pins(START.physics, jnp.asarray(turned)[None]))[0]
    left, right = pins[: len(HELD) // 2], pins[len(HELD) // 2 :]
    np.testing.assert_allclose(pins.mean(axis=0), turned[:3], atol=1e-6)
    drop = np.broadcast_to([0.0, pour_bag.WIDTH - 0.04, 0.0], left.shape)  # a quarter turn: the right hand is below
    np.testing.assert_allclose(left - right, drop, atol=1e-6)


def test_grains_start_in_the_bag_and_stay_there_if_nothing_moves():
    grains = pour_bag.grains_in_bag(0.0175, 0.015)
    assert (grains[:, 1] > pour_bag.bag_height(grains)).all() and grains[:, 1].max() < 0.0
    state = soft_tasks.run("PourBag", START, 0.0, 40)[-1]
    x, bag = np.asarray(state.physics.soft.particles.x), np.asarray(state.physics.soft.thin.x)
    middle = np.asarray(state.physics.joint_q)[:3]
    assert int(state.status) == 0 and int(state.truncated) == 1
    assert (np.abs((x - middle)[:, [0, 2]]) < 0.1).all() and (x[:, 1] > bag[:, 1].min()).all()
    assert (x[:, 1] < middle[1]).all() and float(state.metrics["spilled"]) < 1e-3


def test_no_grain_passes_through_the_bowl():
    """They fall into it from above and lie there for two seconds. None gets to the middle of the wall."""
    sand = ENV.scene.particles.replace(max_active_nodes=None)  # one list would not serve for two seconds
    grains = pour_bag.grains_in_bag(0.0175, 0.0158) + np.asarray(ENV.bowl) + [0.0, 0.15, 0.0]
    still = jax.tree.map(lambda a: a.astype(jnp.float32), ENV.poses(jnp.zeros((1251, 5))))
    step = jax.jit(lambda state: mpm.step(sand, state, still, store_every=None))
    away = np.asarray(step(mpm.initial_state(jnp.asarray(grains, jnp.float32))).x) - np.asarray(ENV.bowl)
    assert (away[:, 1] < 0.0).all() and np.linalg.norm(away, axis=1).max() < pour_bag.RADIUS - 0.01


def test_a_bag_that_is_turned_over_the_bowl_fills_it():
    state, statuses = START, 0
    for step in range(40):
        x = float(state.physics.task[0])
        towards = np.clip((POUR_AT - x) / 0.02, -1.0, 1.0)
        action = [towards, 0.0, 0.0, 0.0, 1.0 if step >= 10 else 0.0]
        state = soft_tasks.run("PourBag", state, jnp.array(action), 1)[-1]
        statuses |= int(state.status)
    assert statuses == 0 and float(state.metrics["inside"]) > 0.85 and float(state.reward) > 0.8


def test_random_actions_do_no_harm():
    """A whole episode of four environments, two of them with the largest actions."""
    env, key = ENV, jax.random.key(3)
    first = jax.jit(jax.vmap(env.reset))(jax.random.split(key, 4))
    actions = jax.random.uniform(key, (env.max_steps, 4, 5), minval=-1.0, maxval=1.0)
    actions = actions.at[:, 2:].set(jnp.sign(jnp.repeat(actions[::4, 2:], 4, axis=0)))

    @jax.jit
    def episode(state, actions):
        def one(state, action):
            state = jax.vmap(env.step)(state, action)
            return state, (state.status, state.reward, state.physics.joint_q)

        return jax.lax.scan(one, state, actions)

    _, (status, reward, q) = episode(first, actions)
    assert not np.asarray(status).any() and np.isfinite(np.asarray(reward)).all()
    assert np.std(np.asarray(reward)[-1]) > 0.01
    assert (np.asarray(q) <= np.asarray(env.joint_upper) + 0.02).all()
    assert (np.asarray(q) >= np.asarray(env.joint_lower) - 0.02).all()


def test_gradients_agree_three_ways(x64):
    """Of the reward by actions, over steps in which grains press on the cloth."""
    errors = soft_tasks.difference_errors(pour_bag.small(), num_steps=3)
    assert errors[:, 0].max() < 1e-8 and errors[:, 1].max() < 1e-4


def test_a_cloud_with_velocities_has_the_positions_of_the_cloud_without():
    physics = START.physics
    points, moving = ENV.observe(physics)["particle_q"], ENV.cloud.replace(velocities=True)
    np.testing.assert_array_equal(
        moving.shown({"particle_q": points}, ENV.points(physics), None)[0]["particle_q"][:, :3], points
    )
