"""Delayed observations show the past, delayed actions act later, gradients follow, and physics stays as it is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import seeing_toys
import toys

from rewax.envs import AutoReset, Randomized, Vmap
from rewax.envs.latency import Latency
from rewax.envs.randomize import Uniform, hook
from rewax.testing import check_env

LENGTH = 6
ACTIONS = jnp.array([0.1, -0.4, 0.3, 0.2, -0.1, 0.4])[:, None]


def rollout(env, state, actions):
    return jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, state, actions)[1]


def run(env, key=0, actions=ACTIONS):
    @jax.jit
    def whole(key, actions):
        first = env.reset(key)
        return first, rollout(env, first, actions)

    return whole(jax.random.key(key), actions)


def test_observations_are_those_of_some_steps_ago_and_nothing_else_changes():
    first, states = run(toys.point_mass(LENGTH))
    start, late = run(Latency(env=toys.point_mass(LENGTH), observation=2))
    path = np.concatenate([first.obs["x"][None], states.obs["x"]])
    seen = np.concatenate([start.obs["x"][None], late.obs["x"]])
    np.testing.assert_array_equal(seen, path[[0, 0, 0, 1, 2, 3, 4]])
    for name in ("physics", "reward", "truncated", "step_count", "metrics"):
        jax.tree.map(np.testing.assert_array_equal, getattr(late, name), getattr(states, name))
    np.testing.assert_array_equal(jax.random.key_data(late.key), jax.random.key_data(states.key))


def test_actions_act_some_steps_later_and_before_them_nothing_is_done():
    shifted = jnp.concatenate([jnp.zeros((2, 1)), ACTIONS[:-2]])
    _, states = run(toys.point_mass(LENGTH), actions=shifted)
    _, late = run(Latency(env=toys.point_mass(LENGTH), action=2))
    np.testing.assert_array_equal(late.physics, states.physics)


def test_only_the_named_observations_are_late():
    env = toys.point_mass(LENGTH)
    np.testing.assert_array_equal(run(Latency(env=env, observation=1, of=()))[1].obs["x"], run(env)[1].obs["x"])
    one = run(Latency(env=env, observation=1, of=("x",)))[1].obs["x"]
    np.testing.assert_array_equal(one[1:], run(env)[1].obs["x"][:-1])


def test_the_gradient_reaches_the_step_that_an_action_acts_in_and_what_is_seen_of_it():
    env = Latency(env=toys.point_mass(LENGTH), observation=1, action=2)

    def results(actions):
        states = run(env, actions=actions)[1]
        return (states.reward, states.obs["x"][:, 0]), states.physics[:, 0]

    (rewards, seen), x = jax.jit(jax.jacobian(results, has_aux=True))(ACTIONS)  # (step, action, 1)
    expected = np.array([[-2.0 * x[t] * 0.5 if a + 2 <= t else 0.0 for a in range(LENGTH)] for t in range(LENGTH)])
    np.testing.assert_allclose(rewards[..., 0], expected, rtol=1e-5)
    np.testing.assert_allclose(
        seen[..., 0], [[0.5 * (a + 3 <= t) for a in range(LENGTH)] for t in range(LENGTH)], rtol=1e-6
    )


def test_a_drawn_delay_is_constant_in_an_episode_and_all_delays_of_the_range_occur():
    env = Vmap(env=AutoReset(env=Latency(env=toys.point_mass(3), observation=(0, 2), action=(1, 2))))
    keys = jax.random.split(jax.random.key(0), 64)
    states = jax.jit(lambda keys: rollout(env, env.reset(keys), jnp.zeros((6, 64, 1))))(keys)
    for name, delays in (("observation_delay", {0, 1, 2}), ("action_delay", {1, 2})):
        drawn = np.asarray(getattr(states.delayed, name))
        assert {*drawn.ravel().tolist()} == delays
        np.testing.assert_array_equal(drawn[0], drawn[1])  # of the first episode
        np.testing.assert_array_equal(drawn[2], drawn[4])  # of the second
        assert (drawn[1] != drawn[2]).any()


def test_a_new_episode_begins_with_its_own_observation_and_no_action_of_the_old_one():
    env = AutoReset(env=Latency(env=toys.point_mass(2), observation=1, action=1))
    _, states = run(env, actions=jnp.full((5, 1), 0.4))
    assert states.truncated.tolist() == [False, True, False, True, False]
    np.testing.assert_array_equal(states.obs["x"][1], states.physics[1])  # of the new episode
    np.testing.assert_array_equal(states.physics[2], states.physics[1])  # the old action does not act in it
    np.testing.assert_allclose(states.final_obs["x"][3], states.physics[2])
    rewards = lambda actions: run(env, actions=actions)[1].reward  # noqa: E731
    slope = jax.jit(jax.jacobian(rewards))(jnp.full((5, 1), 0.4))[..., 0]
    assert slope[4, 0] == slope[4, 1] == slope[2, 0] == 0.0 and slope[3, 2] != 0.0


def test_it_works_around_and_inside_of_randomisation_and_other_latencies():
    gain = hook({"env.gain": Uniform(0.2, 0.3)})
    outside = Randomized(env=Latency(env=toys.point_mass(LENGTH), action=1), randomize=gain)
    first, states = run(outside)
    moved = np.diff(np.concatenate([first.physics, states.physics[:, 0]]))
    np.testing.assert_allclose(moved[1:], float(first.drawn[".env.gain"]) * ACTIONS[:-1, 0], rtol=1e-4)
    inside = Latency(env=Randomized(env=toys.point_mass(LENGTH), randomize=hook({"gain": Uniform(0.2, 0.3)})), action=1)
    first, states = run(inside)
    moved = np.diff(np.concatenate([first.physics, states.physics[:, 0]]))
    np.testing.assert_allclose(moved[1:], float(first.drawn[".gain"]) * ACTIONS[:-1, 0], rtol=1e-4)
    twice = Latency(env=Latency(env=toys.point_mass(LENGTH), observation=1, action=1), observation=1, action=1)
    once = Latency(env=toys.point_mass(LENGTH), observation=2, action=2)
    jax.tree.map(np.testing.assert_array_equal, run(twice)[1].obs, run(once)[1].obs)


def test_latencies_inside_each_other_draw_delays_of_their_own():
    env = Latency(env=Latency(env=toys.point_mass(LENGTH), observation=(0, 5)), observation=(0, 5))
    delayed = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 200)).delayed
    assert 0.05 < float(jnp.mean(delayed.observation_delay == delayed.inner.observation_delay)) < 0.3


@pytest.mark.parametrize("steps", [-1, 1.5, True, (2, 1), (0, 1, 2), (0, 0.5)], ids=str)
def test_delays_that_cannot_be_are_refused(steps):
    for name in ("observation", "action"):
        with pytest.raises(ValueError, match=f"{name} of the latency is .*: give control steps, 2, or the ends"):
            Latency(env=toys.point_mass(), **{name: steps})


@pytest.mark.parametrize("delay", [{"action": 5}, {"observation": 10**9}, {"action": (0, 5)}], ids=str)
def test_a_delay_as_long_as_an_episode_is_refused(delay):
    with pytest.raises(ValueError, match=r"of the latency is .*, but an episode has 5 control steps: give fewer"):
        Latency(env=toys.point_mass(5), **delay)


def test_a_state_of_the_environment_inside_is_refused():
    one = Latency(env=toys.point_mass(), action=1)
    twice = Latency(env=one, action=1)
    for env in (one, twice):
        with pytest.raises(ValueError, match=r"^the state is not of this Latency: begin with reset of the Latency"):
            env.step(env.env.reset(jax.random.key(0)), jnp.zeros(1))


def test_an_unknown_observation_is_refused():
    with pytest.raises(ValueError, match=r"^of is 3: give names of observations, or None for all"):
        Latency(env=toys.point_mass(), of=3)
    for of in (("y",), "y"):
        with pytest.raises(ValueError, match="of has 'y', which is not observed: use some of x"):
            Latency(env=toys.point_mass(), of=of)


def test_an_action_of_another_shape_is_refused():
    env = Latency(env=toys.point_mass(), action=1)
    with pytest.raises(ValueError, match=r"the action has shape \(2,\): give shape \(1,\), and jax.vmap over step"):
        env.step(env.reset(jax.random.key(0)), jnp.zeros(2))


def test_a_seeing_environment_that_is_late_passes_the_check():
    env = Latency(env=seeing_toys.sensing(length=12), observation=(0, 2), action=(0, 1), of=("depth",))
    check_env(env)
    assert env.observation_spec["depth"].shape == (24, 32, 1) and env.world is not None
