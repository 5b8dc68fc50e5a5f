"""Returns along one trajectory against the reference's recursion, explicit sums, and cases by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.agents.returns import short_horizon_return, td_lambda

NUM, LENGTH = 64, 12


def reference_targets(reward, value, done, discount, lambda_):
    """The recursion of SAPO's code; value is 0 where an episode terminated."""
    done = done.copy()
    done[-1] = True
    a, b, ell, targets = 0.0, 0.0, 1.0, np.zeros_like(reward)
    for t in reversed(range(len(reward))):
        end = float(done[t])
        ell = lambda_ * ell * (1 - end) + end
        a = (1 - end) * (lambda_ * discount * a + discount * value[t] + (1 - ell) / (1 - lambda_) * reward[t])
        b = discount * (value[t] * end + b * (1 - end)) + reward[t]
        targets[t] = (1 - lambda_) * a + ell * b
    return targets


def segments(done):
    """First and last step of every segment."""
    starts = [0, *(t + 1 for t in range(len(done) - 1) if done[t])]
    return list(zip(starts, [*(s - 1 for s in starts[1:]), len(done) - 1], strict=True))


def draw(seed=0):
    """Rewards, values (0 where terminated), ends of episodes, discounts and lambdas of many trajectories."""
    rng = np.random.default_rng(seed)
    reward, value = rng.normal(size=(2, NUM, LENGTH))
    done = rng.random((NUM, LENGTH)) < rng.choice([0.0, 0.1, 0.4], (NUM, 1))
    terminated = done & (rng.random((NUM, LENGTH)) < 0.5)
    return reward, np.where(terminated, 0.0, value), done, rng.uniform(0.5, 1.0, NUM), rng.uniform(0.0, 0.99, NUM)


def many_targets(reward, value, done, discount, lambda_):
    return jax.vmap(lambda r, v, d, g, k: td_lambda(r, v, d, discount=g, lambda_=k))(
        *map(jnp.asarray, (reward, value, done, discount, lambda_))
    )


def test_td_lambda_equals_the_reference_recursion(x64):
    drawn = draw()
    expected = [reference_targets(*one) for one in zip(*drawn, strict=True)]
    np.testing.assert_allclose(many_targets(*drawn), expected, rtol=1e-10, atol=1e-12)


def test_td_lambda_by_hand():
    r, v = jnp.array([1.0, 2.0, 4.0]), jnp.array([10.0, 20.0, 40.0])
    no, middle = jnp.array([False] * 3), jnp.array([False, True, False])

    def targets(done, value=v):
        return td_lambda(r, value, done, discount=0.5, lambda_=0.5)

    # G2 = 4 + 0.5 * 40 = 24; G1 = 2 + 0.5 (10 + 12) = 13; G0 = 1 + 0.5 (5 + 6.5) = 6.75
    np.testing.assert_allclose(targets(no), [6.75, 13.0, 24.0])
    # truncated after step 1: G1 = 2 + 0.5 * 20 = 12; G0 = 1 + 0.5 (5 + 6) = 6.5
    np.testing.assert_allclose(targets(middle), [6.5, 12.0, 24.0])
    # terminated there: G1 = 2; G0 = 1 + 0.5 (5 + 1) = 4
    np.testing.assert_allclose(targets(middle, v.at[1].set(0.0)), [4.0, 2.0, 24.0])


def test_td_lambda_zero_bootstraps_after_one_step_and_one_at_the_end_of_the_segment(x64):
    reward, value, done, discount, _ = draw(1)
    one_step = reward + discount[:, None] * value
    np.testing.assert_allclose(many_targets(reward, value, done, discount, np.zeros(NUM)), one_step, rtol=1e-12)
    expected = np.zeros_like(reward)
    for i in range(NUM):
        for first, last in segments(done[i]):
            for t in range(first, last + 1):
                gained = sum(discount[i] ** (k - t) * reward[i, k] for k in range(t, last + 1))
                expected[i, t] = gained + discount[i] ** (last + 1 - t) * value[i, last]
    np.testing.assert_allclose(
        many_targets(reward, value, done, discount, np.ones(NUM)), expected, rtol=1e-10, atol=1e-12
    )


def test_short_horizon_return_equals_a_loop_over_segments(x64):
    reward, value, done, discount, _ = draw(2)
    expected = []
    for i in range(NUM):
        total = 0.0
        for first, last in segments(done[i]):
            total += sum(discount[i] ** (t - first) * reward[i, t] for t in range(first, last + 1))
            total += discount[i] ** (last + 1 - first) * value[i, last]
        expected.append(total)
    got = jax.vmap(lambda r, v, d, g: short_horizon_return(r, v, d, discount=g))(
        *map(jnp.asarray, (reward, value, done, discount))
    )
    np.testing.assert_allclose(got, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("end", [0, 2, 4])
def test_gradient_reaches_values_only_at_the_ends_of_segments(end):
    r, v, done = jnp.arange(5.0), jnp.ones(5), jnp.arange(5) == end
    weights = 0.5 ** np.concatenate([np.arange(end + 1), np.arange(4 - end)])
    ends = (np.arange(5) == end) | (np.arange(5) == 4)
    slope_r, slope_v = jax.grad(lambda r, v: short_horizon_return(r, v, done, discount=0.5), argnums=(0, 1))(r, v)
    np.testing.assert_allclose(slope_r, weights, rtol=1e-6)
    np.testing.assert_allclose(slope_v, np.where(ends, 0.5 * weights, 0.0), rtol=1e-6)
    by_value = jax.jacobian(lambda v: td_lambda(r, v, done, discount=0.5, lambda_=1.0))(v)
    assert (np.asarray(by_value)[:, ~ends] == 0.0).all() and (np.diag(by_value)[ends] == 0.5).all()


def test_a_failed_step_is_worth_the_value_before_it_not_nothing():
    r, v = jnp.array([-1.0, -2.0, 0.0, -4.0]), jnp.array([-10.0, -20.0, 0.0, -40.0])
    done, valid = jnp.array([False, False, True, False]), jnp.array([True, True, False, True])
    got = td_lambda(r, v, done, valid, discount=0.5, lambda_=0.5)
    # step 1 ends the segment with V = -20: G1 = -2 - 10 = -12; G0 = -1 + 0.5 (-5 - 6) = -6.5; G3 = -4 - 20
    np.testing.assert_allclose(got[np.array([0, 1, 3])], [-6.5, -12.0, -24.0])
    # 1 * -1 + 0.5 (-2 + 0.5 * -20), nothing for step 2, then -4 + 0.5 * -40
    got = short_horizon_return(r, v, done, valid, discount=0.5)
    np.testing.assert_allclose(got, -1.0 + 0.5 * (-2.0 - 10.0) - 24.0)


def test_a_failed_step_has_no_gradient():
    done, valid = jnp.array([False, True, False]), jnp.array([True, False, True])
    slope = jax.grad(lambda r: short_horizon_return(r, jnp.ones(3), done, valid, discount=0.5))(jnp.ones(3))
    np.testing.assert_allclose(slope, [1.0, 0.0, 1.0])


def test_steps_that_all_succeed_are_as_without_a_mask(x64):
    reward, value, done, discount, lambda_ = draw(3)
    valid = np.ones_like(done)
    got = jax.vmap(lambda r, v, d, ok, g, k: td_lambda(r, v, d, ok, discount=g, lambda_=k))(
        *map(jnp.asarray, (reward, value, done, valid, discount, lambda_))
    )
    np.testing.assert_array_equal(got, many_targets(reward, value, done, discount, lambda_))
