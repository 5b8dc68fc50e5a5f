"""A policy acting on a line: recorded transitions, and the flow of gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax.agents.rollout import first_episode, masked, rollout
from rewax.envs.randomized import Randomized
from rewax.envs.wrappers import AutoReset

LENGTH, HORIZON, GAIN = 4, 6, 0.5
ENV = AutoReset(env=toys.point_mass(LENGTH))


def proportional(k):
    """A policy that pulls the point to 0: x <- (1 - gain k) x."""
    return lambda obs, key: (-k * obs["x"], {"noise": jax.random.normal(key)})


def run(k, state, differentiate):
    final, transitions = rollout(
        ENV, state, proportional(k), jax.random.key(1), horizon=HORIZON, differentiate=differentiate
    )
    return transitions.reward, (final, transitions)


@pytest.fixture(scope="module")
def state():
    return ENV.reset(jax.random.key(0))


@pytest.fixture(scope="module")
def runs(state):
    """For each way of differentiation: the derivative of the rewards with respect to k, the rewards, and the rest."""

    def both(differentiate):
        def total(k):
            reward, rest = run(k, state, differentiate)
            return reward.sum(), (reward, rest)

        return jax.jit(jax.value_and_grad(total, has_aux=True))(0.4)

    return {d: both(d) for d in ("full", "checkpointed", "none")}


def test_probes_do_not_see_the_gradient_by_drawn_parameters(state):
    """It adds up over the steps, in the parameter's own unit, and would hide how the state's gradient grows."""
    drawing = AutoReset(
        env=Randomized(env=toys.point_mass(LENGTH), randomize=lambda key, env: env.replace(gain=1.0 * env.gain))
    )

    def norms(env):
        begin = env.reset(jax.random.key(0)).replace(physics=state.physics, obs=state.obs)
        assert bool(begin.drawn) == (env is drawing)

        def total(probes):
            _, t = rollout(
                env, begin, proportional(0.4), jax.random.key(1), horizon=3, differentiate="full", probes=probes
            )
            return t.reward.sum()

        return jax.jit(jax.grad(total))(jnp.zeros(3))

    fixed = norms(ENV)
    assert fixed[0] > 0.1
    np.testing.assert_allclose(norms(drawing), fixed, rtol=1e-5)


def test_records_every_step(runs, state):
    _, (reward, (final, transitions)) = runs["full"][0]
    x, fresh = state.physics[0] * 0.8 ** np.arange(LENGTH + 1), transitions.obs["x"][LENGTH, 0]
    assert 0.5 <= fresh <= 1.5
    np.testing.assert_allclose(transitions.obs["x"][:, 0], [*x[:-1], fresh, 0.8 * fresh], rtol=1e-5)
    np.testing.assert_allclose(transitions.next_obs["x"][:, 0], [*x[1:], 0.8 * fresh, 0.64 * fresh], rtol=1e-5)
    np.testing.assert_allclose(transitions.action, -0.4 * transitions.obs["x"], rtol=1e-6)
    np.testing.assert_allclose(reward, -(transitions.next_obs["x"][:, 0] ** 2), rtol=1e-5)
    np.testing.assert_array_equal(transitions.truncated, np.arange(HORIZON) == LENGTH - 1)
    np.testing.assert_array_equal(transitions.terminated, np.zeros(HORIZON, bool))
    np.testing.assert_allclose(final.obs["x"][0], 0.64 * fresh, rtol=1e-5)
    assert len(np.unique(np.asarray(transitions.aux["noise"]))) == HORIZON  # a new key each step


def test_full_equals_checkpointed_equals_the_derivative_by_hand(runs):
    (_, (reward, rest)), slope = runs["full"]
    (_, (again, rest2)), slope2 = runs["checkpointed"]
    np.testing.assert_allclose(again, reward, rtol=1e-6)
    np.testing.assert_allclose(rest2[1].next_obs["x"], rest[1].next_obs["x"], rtol=1e-6)
    np.testing.assert_allclose(slope2, slope, rtol=1e-5)
    x0, fresh = rest[1].obs["x"][0, 0], rest[1].obs["x"][LENGTH, 0]
    # -x0^2 rho^(2 n) with rho = 1 - gain k, and the fresh episode starts anew
    expected = sum(2 * n * GAIN * x**2 * 0.8 ** (2 * n - 1) for x, m in ((x0, 4), (fresh, 2)) for n in range(1, m + 1))
    np.testing.assert_allclose(slope, expected, rtol=1e-5)


def test_none_cuts_every_gradient_and_changes_no_value(runs):
    (_, (reward, rest)), slope = runs["none"]
    assert slope == 0.0
    np.testing.assert_allclose(reward, runs["full"][0][1][0], rtol=1e-6)
    np.testing.assert_allclose(rest[0].physics, runs["full"][0][1][1][0].physics, rtol=1e-6)


@pytest.mark.parametrize("differentiate", ["full", "checkpointed"])
def test_gradient_stops_at_the_end_of_an_episode(state, differentiate):
    def rewards(x):
        return run(0.4, state.replace(physics=x, obs={"x": x}), differentiate)[0]

    slope = np.asarray(jax.jit(jax.jacobian(rewards))(state.physics))[:, 0]
    np.testing.assert_allclose(slope[:LENGTH], -2 * state.physics[0] * 0.8 ** (2 * np.arange(1, LENGTH + 1)), rtol=1e-5)
    np.testing.assert_array_equal(slope[LENGTH:], 0.0)


def test_masked_arrays_keep_their_types():
    tree = {"f": jnp.ones((2, 3)), "u": jnp.ones((2, 3, 4), jnp.uint8), "b": jnp.ones(2, bool)}
    found = masked(tree, jnp.array([True, False]))
    assert jax.tree.map(lambda a: a.dtype, found) == jax.tree.map(lambda a: a.dtype, tree)
    assert all(a[0].all() and not a[1].any() for a in found.values())


def test_needs_automatic_resets(state):
    with pytest.raises(AssertionError, match="AutoReset"):
        rollout(ENV.env, state.replace(final_obs=None), proportional(0.4), jax.random.key(0), horizon=2)


def slopes(state, **options):
    """Gradient of the sum of rewards with respect to the actions of an open loop, and to the probes."""
    actions, probes = 0.1 * np.arange(1.0, 4.0, dtype=np.float32)[:, None], np.zeros(3, np.float32)

    def total(actions, probes):
        play = lambda obs, key, action: (action, {})  # noqa: E731
        _, t = rollout(
            ENV,
            state,
            play,
            jax.random.key(0),
            horizon=3,
            differentiate="full",
            inputs=actions,
            probes=probes,
            **options,
        )
        return t.reward.sum(), t.next_obs["x"][:, 0]

    (by_action, by_probe), x = jax.jit(jax.grad(total, argnums=(0, 1), has_aux=True))(actions, probes)
    return np.asarray(by_action)[:, 0], np.asarray(by_probe), np.asarray(x)


def test_the_gradient_of_the_state_decays_or_is_cut(state):
    by_action, by_probe, x = slopes(state)
    late = -2.0 * GAIN * x  # derivative of each step's own reward with respect to its action
    np.testing.assert_allclose(by_action, np.cumsum(late[::-1])[::-1], rtol=1e-5)
    np.testing.assert_allclose(by_probe, np.abs(np.cumsum((late / GAIN)[::-1])[::-1]), rtol=1e-5)
    decayed, _, same = slopes(state, state_gradient_decay=0.5)
    np.testing.assert_array_equal(same, x)
    np.testing.assert_allclose(
        decayed, [late[0] + 0.5 * late[1] + 0.25 * late[2], late[1] + 0.5 * late[2], late[2]], rtol=1e-5
    )
    cut, _, same = slopes(state, truncate_every=2)
    np.testing.assert_array_equal(same, x)
    np.testing.assert_allclose(cut, [late[0] + late[1], late[1], late[2]], rtol=1e-5)


def test_beyond_its_active_steps_an_environment_stands_still(state):
    def play(num_active):
        return rollout(ENV, state, proportional(0.4), jax.random.key(1), horizon=HORIZON, num_active=num_active)

    end, t = jax.jit(play)(2)
    whole, every = jax.jit(play)(HORIZON)
    np.testing.assert_array_equal(t.active, np.arange(HORIZON) < 2)
    np.testing.assert_array_equal(t.valid, t.active)
    np.testing.assert_array_equal(t.reward, np.where(t.active, every.reward, 0.0))
    assert not t.done[2:].any() and int(end.step_count) == 2 and int(whole.step_count) == HORIZON - LENGTH
    np.testing.assert_array_equal(end.obs["x"], every.obs["x"][2])


def test_environments_with_one_number_of_active_steps_skip_the_others(state):
    """With one number for each, ``vmap`` computes all steps and chooses."""

    def steps_computed(axis, num_active):
        calls = []

        def policy(obs, key):
            jax.debug.callback(lambda: calls.append(1))
            return proportional(0.4)(obs, key)

        def play(state, num_active):
            return rollout(ENV, state, policy, jax.random.key(1), horizon=3, num_active=num_active)[0]

        states = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
        jax.block_until_ready(jax.jit(jax.vmap(play, in_axes=(0, axis)))(states, num_active))
        jax.effects_barrier()
        return len(calls)

    all_steps = steps_computed(0, jnp.asarray([2, 2]))
    assert 3 * steps_computed(None, jnp.asarray(2)) == 2 * all_steps > 0


def test_after_the_first_end_of_an_episode_nothing_happens(runs):
    (_, (_, (_, transitions))), _ = runs["none"]
    own = first_episode(transitions)
    early = np.arange(HORIZON) < LENGTH
    np.testing.assert_array_equal(transitions.active, True)
    np.testing.assert_array_equal(own.active, early)
    np.testing.assert_array_equal(own.valid, early)
    np.testing.assert_array_equal(own.done, transitions.done & early)
    np.testing.assert_array_equal(own.reward, np.where(early, transitions.reward, 0.0))
    assert own.done.sum() == 1 and np.all(transitions.reward[LENGTH:] != 0.0)
