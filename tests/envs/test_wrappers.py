"""What surrounds an environment: automatic resets, batches, time limits, failures, names."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from sharded import traced_under_shard_map

from rewax import struct
from rewax.envs import registry
from rewax.envs.history import History
from rewax.envs.latency import Latency
from rewax.envs.leaves import EnvLeaves, stack
from rewax.envs.randomized import Randomized
from rewax.envs.sensing import Sensing
from rewax.envs.wrappers import AutoReset, Vmap, select
from rewax.status import Status

LENGTH = 3


def rollout(env, state, actions):
    """States after each action, stacked."""

    def step(state, action):
        state = env.step(state, action)
        return state, state

    return jax.lax.scan(step, state, actions)[1]


@struct.dataclass
class Fragile(toys.PointMass):
    """NaN physics, with a NaN derivative, once x exceeds ``limit``."""

    limit: Any

    def step(self, state, action):
        x = state.physics + self.gain * jnp.clip(action, -1.0, 1.0)
        return self.after(state, jnp.sqrt(jnp.where(x > self.limit, -1.0, 1.0) * x**2))


@struct.dataclass
class Terminating(toys.PointMass):
    """Terminates in step 3 of 3, where the time limit is reached too."""

    def step(self, state, action):
        return self.after(state, state.physics, terminated=state.step_count == 2)


def test_auto_reset_keeps_the_last_observation_and_begins_afresh():
    env = AutoReset(env=toys.point_mass(LENGTH))
    first = env.reset(jax.random.key(0))
    np.testing.assert_array_equal(first.final_obs["x"], first.obs["x"])
    states = rollout(env, first, jnp.full((2 * LENGTH, 1), 0.2))
    np.testing.assert_array_equal(states.truncated, [False, False, True] * 2)
    np.testing.assert_array_equal(states.step_count, [1, 2, 0] * 2)
    path = first.physics[0] + 0.1 * jnp.arange(1, LENGTH + 1)
    np.testing.assert_allclose(states.final_obs["x"][:LENGTH, 0], path, rtol=1e-6)
    np.testing.assert_allclose(states.reward[:LENGTH], -(path**2), rtol=1e-6)  # of the step taken, not of the reset
    np.testing.assert_allclose(states.metrics["distance"][LENGTH - 1], path[-1], rtol=1e-6)
    assert 0.5 <= float(states.obs["x"][LENGTH - 1, 0]) <= 1.5
    assert float(states.obs["x"][LENGTH - 1, 0]) != float(states.final_obs["x"][LENGTH - 1, 0])
    np.testing.assert_array_equal(states.obs["x"][:2], states.final_obs["x"][:2])


def test_every_episode_begins_in_another_state_and_repeats_with_its_key():
    env = AutoReset(env=toys.point_mass(LENGTH))
    states = rollout(env, env.reset(jax.random.key(0)), jnp.zeros((10 * LENGTH, 1)))
    starts = np.asarray(states.physics[LENGTH - 1 :: LENGTH, 0])
    assert len(np.unique(starts)) == 10
    again = rollout(env, env.reset(jax.random.key(0)), jnp.zeros((10 * LENGTH, 1)))
    np.testing.assert_array_equal(again.physics, states.physics)


def test_gradient_is_cut_exactly_at_the_boundary_for_that_environment_alone():
    env = Vmap(env=AutoReset(env=toys.point_mass(LENGTH)))
    state = jax.jit(env.reset)(jax.random.split(jax.random.key(0), 2))
    state = state.replace(step_count=jnp.array([0, 2]))  # the second ends in the first step

    def last_rewards(actions):
        return rollout(env, state, actions).reward[1]  # of the second step

    slope = jax.jit(jax.jacobian(last_rewards))(jnp.zeros((2, 2, 1)))[..., 0]  # (reward of env, step, action of env)
    x = jax.jit(lambda actions: rollout(env, state, actions))(jnp.zeros((2, 2, 1))).physics[1, :, 0]
    np.testing.assert_allclose(slope[0, :, 0], [-x[0], -x[0]], rtol=1e-5)  # d(-x^2)/da = -2 x gain
    np.testing.assert_allclose(slope[1, :, 1], [0.0, -x[1]], rtol=1e-5)  # nothing from before the reset
    np.testing.assert_array_equal(slope[0, :, 1], [0.0, 0.0])
    np.testing.assert_array_equal(slope[1, :, 0], [0.0, 0.0])


def test_a_reset_is_computed_only_in_steps_that_end_an_episode():
    resets = []

    @struct.dataclass
    class Counted(toys.PointMass):
        def reset(self, key):
            jax.debug.callback(resets.append, jax.random.key_data(key))
            return super().reset(key)

    env = Vmap(env=AutoReset(env=Counted(gain=jnp.float32(0.5), length=LENGTH)))
    plain = Vmap(env=AutoReset(env=toys.point_mass(LENGTH)))
    state = jax.jit(plain.reset)(jax.random.split(jax.random.key(0), 2))
    states = jax.jit(lambda state: rollout(env, state, jnp.zeros((LENGTH + 1, 2, 1))))(state)
    jax.effects_barrier()
    assert states.done.tolist() == [[False] * 2, [False] * 2, [True] * 2, [False] * 2]
    assert len(resets) == 2


def test_a_step_without_a_reset_has_the_numbers_of_a_step_with_one():
    """The others of a batch decide whether a reset is computed, and never what it is."""
    env = Vmap(env=AutoReset(env=toys.point_mass(LENGTH)))
    state = jax.jit(env.reset)(jax.random.split(jax.random.key(0), 2))

    def step(state, actions):
        return env.step(state, actions).reward.sum(), env.step(state, actions)

    run = jax.jit(jax.value_and_grad(step, argnums=1, has_aux=True))
    some = run(state.replace(step_count=jnp.array([0, LENGTH - 1])), jnp.full((2, 1), 0.3))
    none = run(state, jnp.full((2, 1), 0.3))
    (_, a), slope_a = some
    (_, b), slope_b = none
    assert a.done.tolist() == [False, True] and not b.done.any()
    for name in ("physics", "obs", "final_obs", "reward", "metrics", "step_count"):
        for one, other in zip(*(jax.tree.leaves(getattr(s, name)) for s in (a, b)), strict=True):
            np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_array_equal(slope_a, slope_b)


def test_a_batch_of_batches_is_reset_as_its_environments_alone():
    one = AutoReset(env=toys.point_mass(LENGTH))
    keys = jax.random.split(jax.random.key(0), (2, 3))
    state = jax.jit(jax.vmap(jax.vmap(one.reset)))(keys)
    state = state.replace(step_count=jnp.array([[0, LENGTH - 1, 0], [0, 0, 0]]))
    new = jax.jit(jax.vmap(jax.vmap(one.step)))(state, jnp.full((2, 3, 1), 0.3))
    assert new.done.tolist() == [[False, True, False], [False] * 3]
    step = jax.jit(one.step)
    for i in np.ndindex(2, 3):
        alone = step(jax.tree.map(lambda a, i=i: a[i], state), jnp.full(1, 0.3))
        np.testing.assert_array_equal(new.physics[i], alone.physics)
        assert new.step_count[i] == alone.step_count


def test_resets_and_their_gradient_are_traced_on_a_mesh():
    env = AutoReset(env=toys.point_mass(LENGTH))
    start = env.reset(jax.random.key(0))

    def slope(key_data, actions):
        state = start.replace(key=jax.random.wrap_key_data(key_data), physics=start.physics + 0.0 * actions[0])
        return jax.grad(lambda actions: rollout(env, env.step(state, actions[0]), actions).reward.sum())(actions)

    shape = traced_under_shard_map(slope, jax.random.key_data(start.key), jnp.ones((4, 1)))
    assert shape.shape == (1, 4, 1)


def test_gradient_with_respect_to_the_environment():
    def total(env):
        state = env.reset(jax.random.key(0))
        return jnp.sum(rollout(env, state, jnp.full((2, 1), 0.4)).reward)

    env = toys.point_mass(LENGTH)
    x = float(env.reset(jax.random.key(0)).physics[0])
    expected = -2 * (x + 0.2) * 0.4 - 2 * (x + 0.4) * 0.8
    np.testing.assert_allclose(jax.grad(total)(env).gain, expected, rtol=1e-5)


@struct.dataclass
class Starting(toys.PointMass):
    """A point mass that starts at ``place``."""

    place: jax.Array

    def reset(self, key):
        state = super().reset(key)
        x = self.place * jnp.ones(1)
        return state.replace(physics=x, obs={"x": x})


def test_the_episode_that_a_reset_begins_has_no_gradient_by_the_environment_either():
    def places(place):
        env = AutoReset(env=Starting(gain=jnp.float32(0.5), place=place, length=LENGTH))
        state = env.reset(jax.random.key(0))
        ended = env.step(state.replace(step_count=jnp.int32(LENGTH - 1)), jnp.zeros(1))
        return state.physics[0], ended.final_obs["x"][0], ended.physics[0], ended.obs["x"][0]

    found, slopes = jax.jit(lambda place: (places(place), jax.jacobian(places)(place)))(jnp.float32(0.7))
    assert found == (0.7, 0.7, 0.7, 0.7)
    np.testing.assert_array_equal(slopes, [1.0, 1.0, 0.0, 0.0])


def test_a_failed_environment_ends_and_touches_no_other():
    env = Vmap(env=AutoReset(env=Fragile(gain=jnp.float32(0.5), limit=jnp.float32(1.4), length=LENGTH)))
    keys = jax.random.split(jax.random.key(3), 16)
    state, push = jax.jit(env.reset)(keys), jnp.full((16, 1), 0.5)
    new = jax.jit(env.step)(state, push)
    failed = np.asarray(state.physics[:, 0] + 0.25 > 1.4)
    assert 0 < failed.sum() < 16
    np.testing.assert_array_equal(new.terminated, failed)
    np.testing.assert_array_equal((new.status & Status.NAN) != 0, failed)
    np.testing.assert_array_equal(np.asarray(new.reward)[failed], 0.0)
    for leaf in (new.physics, new.obs["x"], new.final_obs["x"], new.reward, new.metrics["distance"]):
        assert np.isfinite(leaf).all()
    np.testing.assert_array_equal(np.asarray(new.final_obs["x"])[failed], np.asarray(state.obs["x"])[failed])
    alone = jax.jit(jax.vmap(env.env.step))(*jax.tree.map(lambda a: a[~failed], (state, push)))
    np.testing.assert_array_equal(alone.physics, new.physics[~failed])
    slope = jax.jit(jax.jacobian(lambda a: env.step(state, a).reward))(push)[..., 0]
    healthy = np.asarray(slope)[np.ix_(~failed, ~failed)]
    assert np.isfinite(healthy).all() and (np.diag(healthy) != 0).all()
    assert (healthy == np.diag(np.diag(healthy))).all()


@pytest.mark.parametrize(
    ("env", "ends"), [(toys.point_mass(LENGTH), (0, 1)), (Terminating(gain=0.5, length=LENGTH), (1, 0))]
)
def test_terminated_and_truncated_exclude_each_other(env, ends):
    states = rollout(env, env.reset(jax.random.key(0)), jnp.zeros((LENGTH, 1)))
    np.testing.assert_array_equal(states.done, [False] * (LENGTH - 1) + [True])
    assert (int(states.terminated[-1]), int(states.truncated[-1])) == ends


def test_batch_equals_loop():
    env = AutoReset(env=toys.point_mass(2))
    keys, actions = jax.random.split(jax.random.key(0), 4), jnp.linspace(-1, 1, 4)[:, None]

    def two_steps(env):
        return jax.jit(lambda key, action: env.step(env.step(env.reset(key), action), action))

    state, alone = two_steps(Vmap(env=env))(keys, actions), two_steps(env)
    for i in range(4):
        one = alone(keys[i], actions[i])
        np.testing.assert_allclose(state.obs["x"][i], one.obs["x"], rtol=1e-6)
        assert bool(jnp.all(jax.random.key_data(state.key[i]) == jax.random.key_data(one.key)))


def test_a_batch_needs_as_many_keys_and_actions_as_environments():
    env = Vmap(env=toys.point_mass(LENGTH))
    with pytest.raises(ValueError, match=r"^the key is a single one: give one for each environment, jax.random.split"):
        env.reset(jax.random.key(0))
    state = env.reset(jax.random.split(jax.random.key(0), 3))
    for shape in ((2, 1), (1,), ()):
        with pytest.raises(ValueError, match=r"^the action has shape .* for 3 environments: give .*, shape \(3, 1\)$"):
            env.step(state, jnp.zeros(shape))
    with pytest.raises(ValueError, match=r"^the state is not of this Vmap: begin with reset of the Vmap"):
        env.step(env.env.reset(jax.random.key(0)), jnp.zeros((3, 1)))


def test_wrappers_forward_what_they_do_not_change():
    inner = toys.point_mass(LENGTH)
    env = Vmap(env=AutoReset(env=inner))
    assert env.unwrapped is inner and env.episode_length == LENGTH
    assert env.action_spec == inner.action_spec and env.observation_spec == inner.observation_spec


def test_select_chooses_whole_trees_with_keys():
    a, b = ({"x": jnp.full(2, v), "key": jax.random.key(i)} for i, v in enumerate([1.0, jnp.nan]))
    chosen = select(jnp.bool_(True), a, b)
    np.testing.assert_array_equal(chosen["x"], a["x"])
    assert (jax.random.key_data(chosen["key"]) == jax.random.key_data(a["key"])).all()


def test_registry(monkeypatch):
    monkeypatch.setattr(registry, "_FACTORIES", {})
    registry.register("PointMass", toys_factory)
    registry.register("PointMass", toys_factory)  # the same again is no conflict
    assert registry.list_envs() == ["PointMass"]
    assert registry.make("PointMass", scale="paper").episode_length == 50
    assert registry.make("PointMass", scale="small", length=9).episode_length == 9
    assert registry.make("PointMass").episode_length == (5 if registry.default_scale() == "small" else 50)
    with pytest.raises(ValueError, match="named 'PointMass' is registered already: choose another name"):
        registry.register("PointMass", toys.point_mass)
    with pytest.raises(ValueError, match="no environment named 'PointMas': did you mean 'PointMass'"):
        registry.make("PointMas")
    with pytest.raises(ValueError, match="scale is 'huge': use one of 'paper', 'small'"):
        registry.make("PointMass", scale="huge")


def toys_factory(scale, length=None):
    return toys.point_mass(length or (5 if scale == "small" else 50))


OF_ONE_EPISODE = {
    History: lambda env: History(env=env, steps=2),
    Latency: lambda env: Latency(env=env, action=1),
    Randomized: lambda env: Randomized(env=env, randomize=lambda key, env: env),
    Sensing: lambda env: Sensing(env=env),
}


@pytest.mark.parametrize("kind", OF_ONE_EPISODE)
def test_auto_reset_goes_outside(kind):
    """Inside, the old episode's buffers and draws would go on in the new one."""
    sentence = rf"^{kind.__name__} is around AutoReset: put AutoReset outside, AutoReset\(env={kind.__name__}\(env="
    for inside in (toys.point_mass(), OF_ONE_EPISODE[Latency](toys.point_mass())):
        with pytest.raises(ValueError, match=sentence):
            OF_ONE_EPISODE[kind](AutoReset(env=inside))
    with pytest.raises(ValueError, match=r"^the environment has an AutoReset already: give it without"):
        AutoReset(env=AutoReset(env=toys.point_mass()))
    with pytest.raises(ValueError, match=r"^AutoReset is around a batch: put Vmap outside, Vmap\(env=AutoReset\("):
        AutoReset(env=Vmap(env=toys.point_mass()))


@pytest.mark.parametrize("kind", OF_ONE_EPISODE)
def test_a_batch_is_made_of_wrapped_environments(kind):
    with pytest.raises(ValueError, match=f"^{kind.__name__} is around a batch of environments: wrap each environment"):
        OF_ONE_EPISODE[kind](stack([toys.point_mass(), toys.point_mass()]))


@struct.dataclass
class Around(struct.Replaceable):
    """A wrapper of a user's own."""

    env: Any


def test_a_batch_inside_other_wrappers_is_no_batch():
    env = Around(env=stack([toys.point_mass(), toys.point_mass()]))
    assert EnvLeaves.of(env).axis is None and EnvLeaves.of(env.env).axis == 0
