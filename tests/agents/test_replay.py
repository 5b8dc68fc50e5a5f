"""The replay buffer: stored steps, and n-step samples against a loop in numpy."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rewax.agents import replay as replays
from rewax.agents.replay import Step, bytes_of, ended, make_replay

add = jax.jit(replays.add)
sample = jax.jit(replays.sample, static_argnums=2, static_argnames="num_steps")
return_scale = jax.jit(replays.return_scale, static_argnums=2)
NUM_ENVS, CAPACITY, DISCOUNT = 2, 8, 0.5


def steps(first, length, terminated=None, done=None, valid=None):
    """Steps with observations and rewards that encode time and environment: 10 t + env."""
    name = 10.0 * (first + np.arange(length))[:, None] + np.arange(NUM_ENVS)
    no = np.zeros((length, NUM_ENVS), bool)
    return Step(
        obs={"x": jnp.asarray(name[..., None])},
        action=jnp.asarray(name[..., None]),
        reward=jnp.asarray(name),
        next_obs={"x": jnp.asarray(name[..., None] + 0.5)},
        terminated=jnp.asarray(no if terminated is None else terminated),
        done=jnp.asarray(no if done is None else done),
        valid=jnp.asarray(~no if valid is None else valid),
    )


def empty():
    return make_replay(jax.tree.map(lambda a: a[0], steps(0, 1)), CAPACITY)


def test_the_oldest_steps_are_overwritten():
    replay = empty()
    for first in (0, 4, 8):
        replay = add(replay, steps(first, 4))
    assert int(replay.count) == 12 and int(replay.num_filled) == CAPACITY
    drawn = sample(replay, jax.random.key(0), 200, num_steps=1, discount=DISCOUNT)
    times = np.asarray(drawn.obs["x"][:, 0]) // 10
    assert set(times) == set(range(4, 12))
    np.testing.assert_array_equal(drawn.next_obs["x"], drawn.obs["x"] + 0.5)
    assert bytes_of(steps(0, 1), CAPACITY) == CAPACITY * NUM_ENVS * (4 * 4 + 3)


def test_samples_do_not_continue_over_an_end():
    replay = add(ended(add(empty(), steps(0, 4))), steps(4, 4))
    drawn = sample(replay, jax.random.key(0), 200, num_steps=3, discount=DISCOUNT)
    first, last = (np.asarray(obs["x"][:, 0]) // 10 for obs in (drawn.obs, drawn.next_obs))
    np.testing.assert_array_equal(last, np.where(first < 4, np.minimum(first + 2, 3), np.minimum(first + 2, 7)))
    assert np.all(drawn.discount > 0.0)  # no episode terminated: the value of the last state counts
    again = add(ended(empty()), steps(0, 4))
    assert not np.any(again.steps.done[:4])


def expected(start, env, n, terminated, done, valid, count):
    """Reward, discount, time of the last step that counts."""
    total, weight, last = 0.0, 1.0, start
    for t in range(start, min(start + n, count)):
        if not valid[t, env]:
            break
        total += weight * (10.0 * t + env)
        weight, last = weight * DISCOUNT, t
        if done[t, env]:
            break
    return total, 0.0 if terminated[last, env] else weight, last


@given(seed=st.integers(0, 1000), n=st.integers(1, 4), length=st.sampled_from([4, 8, 12]))
def test_n_step_samples_equal_a_loop(seed, n, length):
    rng = np.random.default_rng(seed)
    done = rng.random((length, NUM_ENVS)) < 0.3
    terminated = done & (rng.random((length, NUM_ENVS)) < 0.5)
    valid = rng.random((length, NUM_ENVS)) < 0.8
    replay = empty()
    for first in range(0, length, 4):
        part = slice(first, first + 4)
        replay = add(replay, steps(first, 4, terminated[part], done[part], valid[part]))
    drawn = sample(replay, jax.random.key(seed), 64, num_steps=n, discount=DISCOUNT)
    for i in range(64):
        name = int(drawn.obs["x"][i, 0])
        start, env = divmod(name, 10)
        assert start >= max(0, length - CAPACITY)
        assert bool(drawn.valid[i]) == bool(valid[start, env])
        if not valid[start, env]:
            continue
        reward, weight, last = expected(start, env, n, terminated, done, valid, length)
        np.testing.assert_allclose(
            (drawn.reward[i], drawn.discount[i], drawn.next_obs["x"][i, 0]), (reward, weight, 10 * last + env + 0.5)
        )


@given(seed=st.integers(0, 1000), length=st.sampled_from([4, 8, 12]))
def test_the_scale_of_returns_equals_a_loop(seed, length):
    rng = np.random.default_rng(seed)
    done, valid = (rng.random((length, NUM_ENVS)) < share for share in (0.3, 0.8))
    replay, returns = empty(), []
    for first in range(0, length, 4):
        part = slice(first, first + 4)
        replay = add(replay, steps(first, 4, done=done[part], valid=valid[part]))
    # The ring of 8 holds the steps 8 to 11, then 4 to 7: a return ends where its storage does.
    runs = [range(4)] if length == 4 else [range(8)] if length == 8 else [range(8, 12), range(4, 8)]
    for times in runs:
        for env in range(NUM_ENVS):
            total = 0.0
            for t in reversed(times):
                if not valid[t, env]:
                    total = 0.0
                    continue
                total = 10.0 * t + env + (0.0 if done[t, env] else DISCOUNT * total)
                returns.append(total)
    wanted = np.sqrt(np.mean(np.square(returns))) if np.any(returns) else 1.0
    np.testing.assert_allclose(return_scale(replay, DISCOUNT), wanted, rtol=1e-5)


def test_divided_by_the_scale_no_return_exceeds_a_limit():
    replay = add(empty(), steps(0, 4))
    largest = 21.0 + DISCOUNT * 31.0  # from the third of four steps in the second environment
    assert return_scale(replay, DISCOUNT, 1e3) == return_scale(replay, DISCOUNT)
    np.testing.assert_allclose(return_scale(replay, DISCOUNT, 1.2), largest / 1.2, rtol=1e-5)


def test_without_rewards_the_scale_is_1():
    assert return_scale(empty(), DISCOUNT) == 1.0
