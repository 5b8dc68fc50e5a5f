"""AHAC: the growth of the state's gradient, and the horizon that it sets."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_cases import CASES, ENV, agent

from rewax.agents.ahac import AHACConfig, gradient_growth
from rewax.agents.registry import make_agent
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


@pytest.mark.parametrize(("bound", "way"), [pytest.param(100.0, 1, marks=pytest.mark.slow), (0.01, -1)])
def test_the_horizon_shrinks_where_the_gradient_grows_faster_than_allowed(bound, way):
    config = dataclasses.replace(CASES["ahac"].config, max_growth=bound)
    slow = make_agent("ahac", ENV, config)
    state = slow.init(jax.random.key(0))
    for _ in range(4):
        before = float(state.horizon)
        state, metrics = slow.train_step(state)
        assert np.sign(float(state.horizon) - before) == way or float(state.horizon) in (2.0, 8.0)
        assert metrics["horizon"] == round(before)
    assert float(state.horizon) == (8.0 if way > 0 else 2.0)


def test_only_the_steps_within_the_horizon_are_counted():
    state = agent("ahac").init(jax.random.key(0))
    new, _ = agent("ahac").train_step(state)
    assert int(new.env_steps) == CASES["ahac"].config.num_envs * 4
    moved = np.asarray(new.environments.state.step_count - state.environments.state.step_count) % 5
    assert np.all((moved == 4) | (np.asarray(new.environments.state.step_count) < 4))


def test_horizons_in_a_wrong_order_are_refused():
    with pytest.raises(ValueError, match="give them in this order, the smallest first"):
        AHACConfig(horizon=16, initial_horizon=32)


def test_minibatches_that_do_not_divide_the_environments_are_refused():
    with pytest.raises(
        ValueError, match="critic_minibatches is 4, which does not divide num_envs = 6: choose a divisor"
    ):
        AHACConfig(num_envs=6, critic_minibatches=4)
