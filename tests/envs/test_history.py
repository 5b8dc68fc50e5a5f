"""A history shows the last observations side by side, begins with the first one, and changes nothing else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import seeing_toys
import toys

from rewax.envs import AutoReset
from rewax.envs.history import History
from rewax.envs.latency import Latency
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


def test_it_shows_the_last_observations_and_changes_nothing_else():
    first, states = run(toys.point_mass(LENGTH))
    start, longer = run(History(env=toys.point_mass(LENGTH), steps=3))
    path = np.concatenate([first.obs["x"][None], states.obs["x"]])[:, 0]
    seen = np.concatenate([start.obs["x"][None], longer.obs["x"]])
    indices = np.maximum(np.arange(LENGTH + 1)[:, None] - np.arange(3), 0)
    np.testing.assert_array_equal(seen, path[indices])
    for name in ("physics", "reward", "truncated", "step_count", "metrics"):
        jax.tree.map(np.testing.assert_array_equal, getattr(longer, name), getattr(states, name))


def test_a_new_episode_begins_with_its_own_observation():
    _, states = run(AutoReset(env=History(env=toys.point_mass(2), steps=2)))
    assert states.truncated.tolist() == [False, True] * 3
    np.testing.assert_array_equal(states.obs["x"][1], np.repeat(states.physics[1], 2))
    np.testing.assert_array_equal(states.final_obs["x"][1, 1:], states.obs["x"][0, :1])


def test_pictures_get_channels_and_only_named_observations_are_stacked():
    plain = seeing_toys.sensing()
    picture = next(name for name, spec in plain.observation_spec.items() if len(spec.shape) == 3)
    env = History(env=plain, steps=2, of=(picture,))
    first, states = run(plain, actions=ACTIONS[:2])
    start, longer = run(env, actions=ACTIONS[:2])
    both = jnp.concatenate([states.obs[picture][0], first.obs[picture]], axis=-1)
    np.testing.assert_array_equal(longer.obs[picture][0], both)
    for name, spec in env.observation_spec.items():
        assert start.obs[name].shape == spec.shape
        if name != picture:
            np.testing.assert_array_equal(longer.obs[name], states.obs[name])


def test_the_gradient_reaches_each_step_that_is_shown():
    env = History(env=Latency(env=toys.point_mass(LENGTH), observation=1), steps=2)
    shown = lambda actions: run(env, actions=actions)[1].obs["x"]  # noqa: E731
    seen = jax.jit(jax.jacobian(shown))(ACTIONS)[..., 0]  # (step, shown, action)
    steps = range(LENGTH)
    expected = [[[0.5 * (a + 1 + age <= t) for a in steps] for age in (0, 1)] for t in steps]
    np.testing.assert_allclose(seen, expected, rtol=1e-6)


def test_it_is_an_environment():
    check_env(History(env=toys.point_mass(LENGTH), steps=2))


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"steps": 0}, "steps of the history is 0: give a number of observations, at least 1"),
        ({"steps": 2.0}, "steps of the history is 2.0: give"),
        ({"of": "y"}, "of has 'y', which is not observed: use some of x"),
        ({"of": ("y",)}, "of has 'y', which is not observed: use some of x"),
    ],
)
def test_what_cannot_be_is_a_sentence(options, sentence):
    with pytest.raises(ValueError, match=sentence):
        History(env=toys.point_mass(), **options)


def test_a_state_of_the_environment_inside_is_refused():
    env = History(env=toys.point_mass(), steps=3)
    with pytest.raises(ValueError, match=r"^the state is not of this History: begin with reset of the History"):
        env.step(env.env.reset(jax.random.key(0)), jnp.zeros(1))


def test_an_integer_of_numpy_is_a_number_of_steps():
    assert History(env=toys.point_mass(), steps=np.int64(2)).steps == 2
