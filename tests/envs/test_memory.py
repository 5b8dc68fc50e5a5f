"""The environment carries the memory that the policy returned, zeros at first, and keeps it where a step fails."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax.envs import AutoReset, Vmap, failed_leaf_name
from rewax.envs.memory import MEMORY, Remembered, Remembering, remembering
from rewax.status import Status

SIZE = 3


def remembers(length=4):
    return remembering(toys.point_mass(length), SIZE)


def batch(env, num=3):
    return Vmap(env=AutoReset(env=env)).reset(jax.random.split(jax.random.key(0), num))


def drawn(seed, num=3):
    keys = jax.random.split(jax.random.key(seed))
    return Remembered(0.1 * jax.random.normal(keys[0], (num, 1)), jax.random.normal(keys[1], (num, SIZE)))


def test_the_memory_is_zero_at_first_and_then_what_the_policy_returned():
    env, plain = remembers(), toys.point_mass(4)
    state = env.reset(jax.random.key(1))
    np.testing.assert_array_equal(state.obs[MEMORY], np.zeros(SIZE))
    moved = Remembered(jnp.array([0.2]), jnp.arange(3.0))
    after, without = env.step(state, moved), plain.step(plain.reset(jax.random.key(1)), moved.action)
    np.testing.assert_array_equal(after.obs.pop(MEMORY), moved.memory)
    jax.tree.map(np.testing.assert_array_equal, (after.obs, after.physics, after.reward), (
        without.obs, without.physics, without.reward,
    ))  # fmt: skip
    assert env.observation_spec[MEMORY].shape == (SIZE,) and env.episode_length == 4


def test_the_reset_of_one_environment_leaves_the_memory_of_the_others_as_it_is_to_the_bit():
    env = remembers()
    step = jax.jit(Vmap(env=AutoReset(env=env)).step)
    state = step(batch(env), drawn(0))
    late = state.replace(step_count=state.step_count.at[1].set(3))  # the next step truncates the second environment
    some, none = step(late, drawn(1)), step(state, drawn(1))
    assert some.truncated.tolist() == [False, True, False] and not none.truncated.any()
    np.testing.assert_array_equal(some.obs[MEMORY][1], np.zeros(SIZE))
    np.testing.assert_array_equal(some.final_obs[MEMORY][1], drawn(1).memory[1])
    for others in (0, 2):
        np.testing.assert_array_equal(some.obs[MEMORY][others], drawn(1).memory[others])
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[others], b[others]), some.obs, none.obs)


def test_a_failed_step_keeps_the_memory_and_the_next_episode_begins_with_zeros():
    env = remembers()
    state = batch(env)
    state = Vmap(env=AutoReset(env=env)).step(state, drawn(0))
    spoilt = drawn(1)._replace(memory=jnp.full((3, SIZE), jnp.nan), action=jnp.full((3, 1), jnp.nan))
    after = Vmap(env=AutoReset(env=env)).step(state, spoilt)
    assert after.terminated.all()
    np.testing.assert_array_equal(after.final_obs[MEMORY], drawn(0).memory)
    np.testing.assert_array_equal(after.obs[MEMORY], np.zeros((3, SIZE)))


def test_a_memory_that_is_not_finite_fails_the_step_and_is_named():
    env = remembers()
    state = Vmap(env=env).step(Vmap(env=env).reset(jax.random.split(jax.random.key(0), 3)), drawn(0))
    one_bad = drawn(1)._replace(memory=drawn(1).memory.at[1, 0].set(jnp.nan))
    after = Vmap(env=env).step(state, one_bad)
    np.testing.assert_array_equal(after.status & int(Status.NAN), [0, int(Status.NAN), 0])
    np.testing.assert_array_equal(after.terminated, [False, True, False])
    assert after.reward[1] == 0.0 and after.reward[0] != 0.0
    np.testing.assert_array_equal(after.obs[MEMORY][1], drawn(0).memory[1])
    assert [failed_leaf_name(env, int(leaf)) for leaf in after.failed_leaf] == [
        "nothing",
        "the memory of the policy",
        "nothing",
    ]


def test_an_automatic_reset_inside_is_refused():
    with pytest.raises(ValueError, match="Remembering is around AutoReset: put AutoReset outside"):
        remembering(AutoReset(env=toys.point_mass()), SIZE)


def test_an_action_without_memory_and_a_taken_name_are_sentences():
    env = remembers()
    with pytest.raises(ValueError, match="but it has a memory of 3: let it return Remembered"):
        env.step(env.reset(jax.random.key(0)), jnp.zeros(1))
    with pytest.raises(ValueError, match="has an observation named 'memory', the name of a policy's memory: rename it"):
        remembering(Remembering(env=toys.point_mass(), size=2), SIZE)


@pytest.mark.parametrize(
    ("memory", "sentence"),
    [
        (jnp.ones(1), r"has shape \(1,\): give numbers of shape \(3,\)"),
        (jnp.ones((3, 3)), r"has shape \(3, 3\): give"),
        (1.0, r"has shape \(\): give"),
        (None, "is None, which is no array of real numbers: give numbers of shape"),
    ],
    ids=str,
)
def test_a_memory_of_another_shape_is_refused(memory, sentence):
    env = remembers()
    with pytest.raises(ValueError, match=f"^the memory that the policy returned {sentence}"):
        env.step(env.reset(jax.random.key(0)), Remembered(jnp.zeros(1), memory))


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"size": -1}, "size is -1, but must be an integer of at least 1: give the number of components"),
        ({"size": 1.5}, "size is 1.5, but must be"),
        ({"size": 3, "start": jnp.zeros(2)}, r"start has shape \(2,\): give numbers of shape \(3,\)"),
    ],
    ids=str,
)
def test_a_memory_that_cannot_be_is_refused(options, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}"):
        Remembering(env=toys.point_mass(), **options)


def test_a_list_is_a_memory_and_a_state_without_memory_is_none():
    env = remembers()
    first = env.reset(jax.random.key(0))
    after = env.step(first, Remembered(jnp.zeros(1), [1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(after.obs[MEMORY], [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match=r"^the state is not of this Remembering: begin with reset of the Remembering"):
        env.step(env.env.reset(jax.random.key(0)), Remembered(jnp.zeros(1), jnp.zeros(SIZE)))
