"""What a step may and may not leave behind: failures, their names, and gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import rewax
from rewax.envs.base import NO_LEAF, failed_leaf_name, first_state, next_state
from rewax.status import Status

OBS = {"a": jnp.ones(2), "b": jnp.ones(())}
PHYSICS = {"x": jnp.ones(3), "n": jnp.int32(2)}


def start():
    return first_state(physics=PHYSICS, obs=OBS, metrics={"m": jnp.ones(())}, key=jax.random.key(0))


def step(physics=PHYSICS, obs=OBS, reward=2.0, **kwargs):
    metrics = {"m": jnp.zeros(())}
    return next_state(
        start(), physics=physics, obs=obs, reward=jnp.asarray(reward), metrics=metrics, episode_length=5, **kwargs
    )


class Known:
    """Just enough of an environment to name its arrays."""

    def reset(self, key):
        del key
        return start()


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"physics": {**PHYSICS, "x": jnp.array([1.0, jnp.nan, 1.0])}}, "physics['x']"),
        ({"obs": {**OBS, "a": jnp.array([1.0, jnp.inf])}}, "obs['a']"),
        ({"obs": {**OBS, "b": jnp.asarray(jnp.nan)}, "reward": jnp.nan}, "obs['b']"),
        ({"reward": jnp.nan}, "reward"),
        ({"status": int(Status.NAN)}, "status"),
        ({}, "nothing"),
    ],
)
def test_the_first_array_that_failed_has_a_name(changes, name):
    state = step(**changes)
    assert failed_leaf_name(Known(), int(state.failed_leaf)) == name
    assert bool(state.terminated) == (name != "nothing") and (int(state.failed_leaf) == NO_LEAF) == (name == "nothing")
    assert state.reward == (2.0 if name == "nothing" else 0.0)
    np.testing.assert_array_equal(state.obs["a"], OBS["a"])


def test_the_bit_nan_says_that_a_number_is_not_finite():
    assert step(status=int(Status.INVALID_PARAMETERS)).status == Status.INVALID_PARAMETERS
    assert step(reward=jnp.nan, status=int(Status.CFL)).status == Status.NAN | Status.CFL


@pytest.mark.parametrize(
    ("changes", "status", "name"),
    [
        ({"physics": {**PHYSICS, "x": jnp.array([1.0, jnp.nan, 1.0])}}, Status.NAN, "physics['x']"),
        ({"obs": {**OBS, "b": jnp.asarray(jnp.inf)}}, Status.NAN, "obs['b']"),
        ({"physics": {**PHYSICS, "y": 2.0}}, Status.OK, "nothing"),
    ],
)
def test_a_reset_that_is_not_finite_says_so_and_its_first_step_ends_the_episode(changes, status, name):
    parts = {"physics": PHYSICS, "obs": OBS, "metrics": {"m": jnp.ones(())}, "key": jax.random.key(0), **changes}
    first = first_state(**parts)
    assert first.status == status and not bool(first.done)
    assert failed_leaf_name(Known(), int(first.failed_leaf)) == name
    same = {"physics": first.physics, "obs": first.obs, "reward": first.reward, "metrics": first.metrics}
    after = next_state(first, **same, episode_length=5)
    assert after.status == status and bool(after.terminated) == (status != Status.OK) and after.reward == 0.0


def test_what_follows_an_observation_that_is_not_finite_is_no_data():
    """A policy chose its action from such numbers. Physics alone may be finite again."""
    unseen = {**OBS, "b": jnp.asarray(jnp.inf)}
    first = first_state(physics=PHYSICS, obs=unseen, metrics={"m": jnp.ones(())}, key=jax.random.key(0))
    good = {"physics": PHYSICS, "obs": OBS, "reward": jnp.asarray(2.0), "metrics": first.metrics}
    after = next_state(first, **good, episode_length=5)
    assert after.status == Status.NAN and bool(after.terminated) and after.reward == 0.0
    assert failed_leaf_name(Known(), int(after.failed_leaf)) == "obs['b']"
    odd = {**PHYSICS, "x": jnp.array([1.0, jnp.nan, 1.0])}
    first = first_state(physics=odd, obs=OBS, metrics={"m": jnp.ones(())}, key=jax.random.key(0))
    assert first.status == Status.NAN and next_state(first, **good, episode_length=5).status == Status.OK


def test_names_are_those_of_a_task():
    env = rewax.make("CartpoleSwingUp", scale="small")
    assert failed_leaf_name(env, 0) == "physics.rigid.qpos"


def test_a_failed_step_passes_no_gradient():
    """Neither to what led to it nor to what it kept."""

    def after(x, bad):
        state = step(physics={**PHYSICS, "x": jnp.where(bad, jnp.nan, x)}, obs={**OBS, "a": x[:2]}, reward=x[0])
        return state.physics["x"].sum() + state.obs["a"].sum() + state.reward

    x = jnp.arange(3.0)
    np.testing.assert_array_equal(jax.grad(after)(x, True), np.zeros(3))
    np.testing.assert_array_equal(jax.grad(after)(x, False), [3.0, 2.0, 1.0])


def test_a_toy_that_fails_starts_anew_with_no_trace():
    env = toys.point_mass()
    state = env.reset(jax.random.key(0))
    failed = env.after(state, jnp.full(1, jnp.nan))
    assert failed.failed_leaf == 0 and failed_leaf_name(env, 0) == "physics"
    assert env.after(failed, jnp.ones(1)).failed_leaf == NO_LEAF
