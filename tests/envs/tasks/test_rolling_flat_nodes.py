"""RollingFlat on the nodes near its dough does what it does on all nodes, and says so where it does not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.envs.tasks.rolling_flat import paper, small
from rewax.physics import mpm
from rewax.status import Status

HELD = np.asarray([(0.0, -1.0, -1.0), (0.0, -1.0, 1.0), (1.0, -1.0, 0.0), (-1.0, -1.0, 0.0)], np.float32)
"""Held to the end of an episode: they press the dough against the sides of the box and between pin and table."""


def everywhere(env):
    """The same environment with a place for every node."""
    return env.replace(scene=env.scene.replace(max_active_nodes=None))


def same(a, b, tolerance):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=tolerance * max(1.0, float(np.abs(y).max())))


def run(env, state, actions):
    """The last state, and the status of every step, of a batch of states with actions (steps, num_envs, 3)."""

    def step(state, action):
        new = jax.vmap(env.step)(state, action)
        return new, new.status

    return jax.jit(lambda state, actions: jax.lax.scan(step, state, actions))(state, actions)


# --- small -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def held():
    """Whole episodes of small with held actions: on the listed nodes and on all."""
    env = small()
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), len(HELD)))
    actions = jnp.broadcast_to(HELD, (env.episode_length, *HELD.shape))
    return run(env, state, actions), run(everywhere(env), state, actions)


def test_small_with_held_actions_is_the_same_on_all_nodes(held):
    (listed, status), (whole, _) = held
    assert not np.any(status & Status.INACTIVE_NODES)
    same(listed.physics, whole.physics, 1e-6)


def test_small_with_held_actions_stays_off_the_bounds_of_the_grid(held):
    (_, status), _ = held
    assert not np.any(status & Status.OUT_OF_DOMAIN)


# --- paper -----------------------------------------------------------------------------------------------------------


def spread(env):
    """Dough rolled flat along the whole table and flung to one side: more nodes and speed than rolling gives it."""
    state = env.reset(jax.random.key(0))
    low, high = env.rest_positions.min(0), env.rest_positions.max(0)
    x = (env.rest_positions - low) / (high - low) * jnp.array([0.7, 0.06, 0.55]) + jnp.array([0.1, 0.07, 0.1])
    v = jnp.broadcast_to(jnp.array([0.0, 2.0, 20.0]), x.shape)
    dough = state.physics.soft.replace(x=x, v=v)
    return state.replace(physics=state.physics.replace(soft=dough, joint_q=jnp.array([0.3, 0.1325, 0.0])))


@pytest.mark.slow
def test_paper_with_dough_all_over_the_table_is_the_same_on_all_nodes():
    env = paper()
    state = jax.tree.map(lambda a: a[None], spread(env))
    assert int(mpm.count_nodes(env.scene.grid, state.physics.soft.x[0])) > 5120
    actions = jnp.asarray([[[1.0, -1.0, 1.0]]])
    (listed, status), (whole, _) = run(env, state, actions), run(everywhere(env), state, actions)
    moved = jnp.abs(listed.physics.soft.x - state.physics.soft.x).max()
    assert moved > 1.5 * env.scene.grid.spacing  # further than one list reaches
    assert not np.any(status & Status.INACTIVE_NODES)
    same(listed.physics, whole.physics, 1e-6)


@pytest.mark.slow
def test_paper_with_held_actions_is_the_same_on_all_nodes():
    env = paper()
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(3), 2))
    actions = jnp.broadcast_to(HELD[:2], (60, 2, 3))
    (listed, status), (whole, _) = run(env, state, actions), run(everywhere(env), state, actions)
    assert not np.any(status & (Status.INACTIVE_NODES | Status.OUT_OF_DOMAIN))
    same(listed.physics, whole.physics, 1e-6)


# --- What is flagged -------------------------------------------------------------------------------------------------


STEP = jax.jit(lambda env, state: env.step(state, jnp.zeros(3)))


def short_lists():
    """Small with two lists a step, the pin at the side, and gravity that turns a throw back within a control step."""
    env = small()
    gravity = jnp.array([0.0, -1e4, 0.0])
    joint_start = env.joint_upper.at[2].set(0.0)
    return env.replace(scene=env.scene.replace(gravity=gravity), joint_start=joint_start, list_every=5)


def with_dough(state, **changes):
    return state.replace(physics=state.physics.replace(soft=state.physics.soft.replace(**changes)))


def test_dough_that_needs_more_nodes_than_a_list_holds_is_flagged():
    env = short_lists()
    box = jnp.asarray(np.random.default_rng(0).uniform((0.2, 0.1, 0.3), (0.8, 0.28, 0.7), env.rest_positions.shape))
    state = STEP(env, with_dough(env.reset(jax.random.key(0)), x=box.astype(env.rest_positions.dtype)))
    assert int(mpm.count_nodes(env.scene.grid, box)) > env.scene.max_active_nodes
    assert int(state.status) & Status.INACTIVE_NODES
    assert not bool(state.terminated)


def test_dough_that_leaves_a_list_on_its_way_is_flagged_though_it_comes_back():
    """Each list of a control step is checked, not only the last state against the first."""
    env = short_lists()
    dough = env.reset(jax.random.key(0)).physics.soft
    thrown = {"x": dough.x.at[:, 1].add(0.04), "v": dough.v.at[:, 1].set(0.5 * 1e4 * env.control_dt)}
    state = with_dough(env.reset(jax.random.key(0)), **thrown)
    end = STEP(env, state)
    whole = mpm.check_status(env.scene, end.physics.soft, start=state.physics.soft)
    assert int(end.status) & Status.INACTIVE_NODES
    assert not int(whole) & Status.INACTIVE_NODES
