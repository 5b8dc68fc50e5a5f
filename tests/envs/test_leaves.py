"""Environments as data: partitioned and rebuilt, stacked, and never constants of a program."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import rewax
from rewax.envs.leaves import EnvLeaves, stack
from rewax.envs.wrappers import Vmap


def gains(*values):
    return [toys.point_mass().replace(gain=jnp.float32(g)) for g in values]


def test_a_partitioned_environment_is_rebuilt_equal():
    env = rewax.make("RollingFlat", scale="small")
    leaves = EnvLeaves.of(env)
    again = leaves.build()
    assert jax.tree.structure(again) == jax.tree.structure(env)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(env), strict=True):
        np.testing.assert_array_equal(a, b)
    assert leaves.arrays[".scene.material.elasticity.youngs_modulus"] == 750.0
    assert not any(number is not None for number in leaves.form.numbers)
    # What is absent is None: a wall without friction costs nothing.
    assert again.scene.walls.lower[0].friction is None
    assert not any("friction" in name and "walls" in name for name in leaves.arrays)
    assert not any(a.weak_type for a in leaves.arrays.values())


def test_other_values_compile_nothing():
    @jax.jit
    def end(leaves):
        env = leaves.build()
        return env.step(env.reset(jax.random.key(0)), jnp.ones(1)).physics

    one, two = (end(EnvLeaves.of(env)) for env in gains(0.5, 0.25))
    assert end._cache_size() == 1 and one != two


def test_equal_numbers_of_other_types_are_other_programs():
    """1 == 1.0 == True and 0.0 == -0.0, but programs with them differ."""
    multiply = jax.jit(lambda leaves: jnp.arange(3) * leaves.build()["k"])
    found = [multiply(EnvLeaves.of({"k": k})).dtype for k in (1, 1.0, True)]
    assert found == [jnp.int32, jnp.float32, jnp.int32]
    negative = jax.jit(lambda leaves: jnp.signbit(jnp.float32(leaves.build()["k"])))
    assert [bool(negative(EnvLeaves.of({"k": k}))) for k in (0.0, -0.0)] == [False, True]
    assert isinstance(stack([{"k": 1}, {"k": 1}]).env["k"], int)
    assert stack([{"k": 1}, {"k": 1.0}]).env["k"].shape == (2,)


def test_a_batch_is_a_loop():
    envs, keys, action = gains(0.1, 0.5, 1.0), jax.random.split(jax.random.key(1), 3), jnp.full((3, 1), 0.7)
    batch = stack(envs)
    assert batch.env_axis == 0 and batch.action_spec == envs[0].action_spec and batch.episode_length == 5
    assert batch.observation_spec == envs[0].observation_spec
    states = jax.jit(lambda batch: batch.step(batch.reset(keys), action))(batch)
    one = jax.jit(lambda env, key, action: env.step(env.reset(key), action))
    for i, env in enumerate(envs):
        alone = one(env, keys[i], action[i])
        np.testing.assert_allclose(states.physics[i], alone.physics, rtol=1e-6)
    leaves = EnvLeaves.of(batch)
    assert leaves.axis == 0 and leaves.first().gain == jnp.float32(0.1)
    leaves.check_size(3)
    with pytest.raises(ValueError, match=r"^num_envs is 4, but .gain of the batch has shape \(3,\): give every"):
        leaves.check_size(4)


def test_each_environment_of_a_batch_has_a_gradient_of_its_own():
    batch = stack(gains(0.1, 0.5))
    keys = jax.random.split(jax.random.key(0), 2)

    def rewards(env):
        first = batch.reset(keys)
        return Vmap(env=env, env_axis=0).step(first, jnp.ones((2, 1))).reward, first.physics[:, 0]

    jacobian, x = jax.jit(jax.jacobian(rewards, has_aux=True))(batch.env)
    jacobian = np.asarray(jacobian.gain)
    np.testing.assert_allclose(jacobian, np.diag(-2 * (x + np.array([0.1, 0.5]))), rtol=1e-5)


def test_what_cannot_be_stacked_says_so():
    with pytest.raises(ValueError, match=r"^envs is empty: give at least one environment$"):
        stack([])
    with pytest.raises(ValueError, match="differ in a static field"):
        stack([toys.point_mass(5), toys.point_mass(6)])
    with pytest.raises(
        ValueError, match=r"a parameter has shapes \[\(\), \(2,\)\]: give it the same shape in all environments"
    ):
        stack([toys.point_mass(), toys.point_mass().replace(gain=jnp.ones(2))])
    with pytest.raises(ValueError, match=r"^env_axis is 1: give 0 for a batch"):
        Vmap(env=toys.point_mass(), env_axis=1)
