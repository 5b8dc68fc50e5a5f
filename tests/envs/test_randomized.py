"""Parameters drawn anew at each reset, and at no other time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax import struct
from rewax.envs.randomize import Constant, Scale, hook
from rewax.envs.randomized import Randomized, changed_by, check_hook
from rewax.envs.wrappers import AutoReset, _Wrapper


def draw(key, env):
    return env.replace(gain=env.gain * jax.random.uniform(key, minval=0.5, maxval=2.0))


ENV = AutoReset(env=Randomized(env=toys.point_mass(), randomize=draw))


@pytest.fixture(scope="module")
def states():
    """A start and twelve steps of episodes of five, with actions of 0.1."""

    @jax.jit
    def run(env, key):
        def step(state, _):
            new = env.step(state, jnp.full(1, 0.1))
            return new, new

        start = env.reset(key)
        return start, jax.lax.scan(step, start, None, length=12)[1]

    start, after = run(ENV, jax.random.key(0))
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), *(jax.tree.map(_raw, s) for s in (start, after)))


def _raw(a):
    return jax.random.key_data(a) if jnp.issubdtype(a.dtype, jax.dtypes.prng_key) else a


def test_leaves_change_with_each_episode_only(states):
    gain = np.asarray(states.drawn[".gain"])
    episode = np.arange(13) // 5  # the step that ends an episode returns the next one's beginning
    assert set(states.drawn) == {".gain"}
    for i in range(3):
        assert len(set(gain[episode == i])) == 1
    assert len(set(gain)) == 3 and (gain >= 0.25).all() and (gain <= 1.0).all()


def test_the_drawn_leaves_are_those_that_act(states):
    x, gain = np.asarray(states.physics)[:, 0], np.asarray(states.drawn[".gain"])
    for t in (0, 1, 5, 6, 10):
        np.testing.assert_allclose(x[t + 1] - x[t], 0.1 * gain[t], rtol=1e-4)


def test_values_and_gradients_are_those_of_the_environment_with_these_leaves():
    env = ENV.env
    state = env.reset(jax.random.key(3))
    plain = toys.point_mass().replace(gain=state.drawn[".gain"])

    def reward(action, env):
        return env.step(state, action).reward

    for f in (reward, jax.grad(reward)):
        np.testing.assert_array_equal(f(jnp.full(1, 0.3), env), f(jnp.full(1, 0.3), plain))


@pytest.mark.parametrize(
    ("hook", "sentence"),
    [
        (lambda key, env: env.replace(length=6), "randomize changed a static field"),
        (lambda key, env: None, "randomize returned None: return the environment with other parameters"),
        (None, r"randomize is None: give a function \(key, env\) -> env"),
        ({"gain": 1.0}, r"randomize is \{'gain': 1.0\}: give a function \(key, env\) -> env"),
        (lambda key, env: env.replace(gain=jnp.ones(3)), r"randomize gave .gain shape \(3,\) instead of \(\)"),
    ],
)
def test_a_hook_may_draw_leaves_only(hook, sentence):
    with pytest.raises(ValueError, match=sentence):
        Randomized(env=toys.point_mass(), randomize=hook).reset(jax.random.key(0))


def test_a_hook_is_checked_before_it_is_wrapped():
    with pytest.raises(ValueError, match=r"^randomize is \{'gain': 1.0\}: give a function"):
        check_hook(toys.point_mass(), {"gain": 1.0})


def test_a_state_without_draws_is_refused():
    env = ENV.env
    with pytest.raises(ValueError, match=r"^the state is not of this Randomized: begin with reset of the Randomized"):
        env.step(env.env.reset(jax.random.key(0)), jnp.zeros(1))
    nothing = Randomized(env=toys.point_mass(), randomize=lambda key, env: env)
    assert nothing.step(nothing.reset(jax.random.key(0)), jnp.zeros(1)).drawn == {}


def test_draws_inside_draws_all_act_until_the_next_reset():
    inside = Randomized(env=toys.point_mass(), randomize=draw)
    outside = Randomized(env=inside, randomize=hook({"env.gain": Scale(Constant(3.0))}))
    state = outside.reset(jax.random.key(0))
    gain = state.drawn[".gain"]
    assert 0.75 <= gain <= 3.0 and state.drawn["1:.env.gain"] == 1.5 and gain != 1.5
    moved = outside.step(state, jnp.full(1, 0.1)).physics - state.physics
    np.testing.assert_allclose(moved, 0.1 * gain, rtol=1e-4)


@struct.dataclass
class Louder(_Wrapper):
    """Actions are multiplied by a number."""

    gain: jax.Array

    def step(self, state, action):
        return self.env.step(state, self.gain * action)


def test_names_of_one_layer_are_not_those_of_another():
    """``.env.gain`` is another number below the outer layer than below the inner one."""
    wrapped = Louder(env=Louder(env=toys.point_mass(), gain=jnp.float32(0.25)), gain=jnp.float32(0.5))
    inside = Randomized(env=wrapped, randomize=hook({"env.env.gain": Constant(0.7)}))
    outside = Randomized(env=inside, randomize=hook({"env.gain": Constant(3.0)}))
    state = outside.reset(jax.random.key(0))
    moved = outside.step(state, jnp.full(1, 0.1)).physics - state.physics
    np.testing.assert_allclose(moved, 0.1 * 3.0 * 0.25 * 0.7, rtol=1e-5)


@struct.dataclass
class Counting(struct.Replaceable):
    """Stands for an environment with a whole number among its parameters."""

    num_pushes: jax.Array
    gain: jax.Array


def test_a_draw_is_never_rounded_to_a_whole_number():
    env = Counting(num_pushes=jnp.int32(3), gain=jnp.float32(1.0))
    sentence = r"^randomize gave .num_pushes the type float32 instead of int32: draw whole numbers, or make"
    with pytest.raises(ValueError, match=sentence):
        changed_by(
            lambda key, env: env.replace(num_pushes=jax.random.uniform(key, (), maxval=9.0)), jax.random.key(0), env
        )
    drawn = changed_by(lambda key, env: env.replace(num_pushes=5, gain=2), jax.random.key(0), env)
    assert drawn[".num_pushes"] == 5 and drawn[".num_pushes"].dtype == jnp.int32
    assert drawn[".gain"] == 2.0 and drawn[".gain"].dtype == jnp.float32
