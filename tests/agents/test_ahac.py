"""AHAC: the growth of the state's gradient, and the horizon that it sets."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from agent_cases import CASES, agent

from rewax.agents.ahac import AHACConfig, gradient_growth, horizon_update, on_schedule
from rewax.agents.rollout import Transition


def transitions(done, active):
    fields = dict.fromkeys(Transition._fields)
    no = jnp.zeros_like(jnp.asarray(done))
    return Transition(**{**fields, "terminated": jnp.asarray(done), "truncated": no, "active": jnp.asarray(active)})


def test_growth_is_the_mean_logarithm_of_the_ratio_of_norms():
    norms = jnp.array([[8.0, 4.0, 2.0, 1.0]])  # doubles with each step backwards
    no, yes = np.zeros((1, 4), bool), np.ones((1, 4), bool)
    assert gradient_growth(norms, transitions(no, yes)) == pytest.approx(np.log(2.0))
    odd = norms.at[0, 0].set(1e9)  # a step before the end of an earlier episode
    ended = no.copy()
    ended[0, 0] = True
    assert gradient_growth(odd, transitions(ended, yes)) == pytest.approx(np.log(2.0))
    late = norms.at[0, 3].set(0.0)  # beyond the horizon
    short = yes.copy()
    short[0, 3] = False
    assert gradient_growth(late, transitions(no, short)) == pytest.approx(np.log(2.0))
    assert gradient_growth(norms.at[0, 1].set(jnp.nan), transitions(no, yes)) == pytest.approx(np.log(2.0))
    over = np.log(np.finfo(np.float32).max / 4.0) + 2.0 * np.log(2.0)
    assert gradient_growth(norms.at[0, 0].set(jnp.inf), transitions(no, yes)) == pytest.approx(over / 3.0)
    assert np.isnan(gradient_growth(jnp.full((1, 4), jnp.nan), transitions(no, yes)))


def test_a_growth_that_is_not_known_leaves_the_horizon():
    state = agent("ahac").init(jax.random.key(0)).replace(horizon=jnp.full((), 9.5))
    assert float(horizon_update(AHACConfig(), state, jnp.full((), jnp.nan))[0].horizon) == 9.5


def test_the_horizon_moves_against_the_excess_of_the_growth():
    config = CASES["ahac"].config
    state = agent("ahac").init(jax.random.key(0))
    for _ in range(4):
        before = float(state.horizon)
        state, metrics = agent("ahac").train_step(state)
        steps = round(before)
        assert metrics["horizon"] == steps
        allowed = max(np.log(config.max_growth), np.log(steps) / (steps - 1))
        after = np.clip(before - (np.log(metrics["growth"]) - allowed), config.min_horizon, config.horizon)
        assert float(state.horizon) == pytest.approx(after, rel=1e-5)


@pytest.mark.parametrize(("bound", "growth", "after"), [(1.1, 1.5, 39.69), (1.6, 1.5, 40.06), (1.1, 1e16, 8.0)])
def test_the_horizon_shrinks_where_the_gradient_grows_faster_than_allowed(bound, growth, after):
    state = agent("ahac").init(jax.random.key(0)).replace(horizon=jnp.full((), 40.0))
    config = AHACConfig(max_growth=bound)
    new, metrics = horizon_update(config, state, jnp.log(growth))
    assert float(new.horizon) == pytest.approx(after, abs=0.01) and float(metrics["growth"]) == pytest.approx(growth)


@pytest.mark.parametrize("horizon", [4, 16])
def test_a_sum_of_equal_rewards_leaves_the_horizon(horizon):
    """Its gradient adds up from the end, by more than ``max_growth`` per step where the horizon is short."""
    config = dataclasses.replace(CASES["ahac"].config, horizon=64, min_horizon=2)
    state = agent("ahac").init(jax.random.key(0)).replace(horizon=jnp.full((), float(horizon)))
    norms = jnp.arange(horizon, 0.0, -1.0)[None]
    growth = gradient_growth(norms, transitions(np.zeros((1, horizon), bool), np.ones((1, horizon), bool)))
    assert jnp.exp(growth) > config.max_growth
    assert horizon_update(config, state, growth)[0].horizon == pytest.approx(horizon, abs=1e-5)
    assert horizon_update(config, state, growth + 0.1)[0].horizon == pytest.approx(horizon - 0.1, abs=1e-5)


def counts(*optimizer_states):
    """Numbers of updates from which the learning rates follow."""
    leaves = jax.tree.leaves(optimizer_states, is_leaf=lambda part: isinstance(part, optax.ScaleByScheduleState))
    return [int(part.count) for part in leaves if isinstance(part, optax.ScaleByScheduleState)]


def test_the_learning_rates_fall_with_the_steps_of_the_run():
    config = CASES["ahac"].config
    state = agent("ahac").init(jax.random.key(0))
    start = on_schedule(config, state.replace(iteration=jnp.asarray(9, jnp.int32)))
    assert counts(start.actor_opt, start.critic_opt) == [0, 0]
    later = state.replace(env_steps=jnp.asarray(5 * config.num_envs * config.initial_horizon, jnp.int32))
    new, _ = agent("ahac").train_step(later)
    assert counts(new.actor_opt, new.critic_opt) == [6, 6 * config.critic_passes * config.critic_minibatches]


def test_only_the_steps_within_the_horizon_are_counted():
    state = agent("ahac").init(jax.random.key(0))
    new, _ = agent("ahac").train_step(state)
    assert int(new.env_steps) == CASES["ahac"].config.num_envs * 4
    moved = np.asarray(new.environments.state.step_count - state.environments.state.step_count) % 5
    assert np.all((moved == 4) | (np.asarray(new.environments.state.step_count) < 4))


def test_horizons_in_a_wrong_order_and_of_one_step_are_refused():
    """A horizon of one step would stay, because the growth over it is not known."""
    with pytest.raises(ValueError, match="give them in this order, the smallest first"):
        AHACConfig(horizon=16, initial_horizon=32)
    with pytest.raises(ValueError, match="min_horizon is 1: give an integer of at least 2"):
        AHACConfig(min_horizon=1)
    assert np.isnan(gradient_growth(jnp.ones((1, 4)), transitions(np.zeros((1, 4), bool), np.arange(4)[None] < 1)))


def test_minibatches_that_do_not_divide_the_environments_are_refused():
    with pytest.raises(
        ValueError, match="critic_minibatches is 4, which does not divide num_envs = 6: choose a divisor"
    ):
        AHACConfig(num_envs=6, critic_minibatches=4)
