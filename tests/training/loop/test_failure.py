"""When a run counts as failed, by hand."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax import struct
from rewax.agents.run_state import Environments, RunState
from rewax.envs import base
from rewax.envs.base import first_state
from rewax.training.config import ReportConfig
from rewax.training.loop.failure import FailureWatch, FiniteCheck

ENV = toys.point_mass(length=10)


def watch(**changes):
    return FailureWatch(ENV, ReportConfig(failure_window=3, **changes))


def test_stops_above_the_share_of_a_whole_window():
    followed = watch()
    for iteration, failed in enumerate((4, 4, 0), start=1):
        assert not followed.reason()
        followed.add(iteration, 10, {"failed_episodes": failed, "episodes": 4})
    assert followed.reason().startswith(
        "8 of 12 episodes failed numerically in the last 3 iterations (max_failed_share"
    )
    assert not followed.healthy
    followed.add(4, 10, {"failed_episodes": 0, "episodes": 4})  # the first iteration leaves the window
    assert not followed.reason() and followed.healthy


def test_less_than_a_window_counts_at_the_end():
    followed = watch()
    followed.add(1, 10, {"failed_episodes": 4, "episodes": 4})
    assert not followed.reason() and "4 of 4 episodes" in followed.reason(final=True)


def test_episodes_under_way_count():
    """Of 20 environments one fails; the others are in the middle of their 10 steps, so none has ended."""
    followed = watch()
    for iteration in range(1, 4):
        followed.add(iteration, 100, {"failed_episodes": 1, "episodes": 1})
    assert not followed.reason(final=True)


@pytest.mark.parametrize(("share", "stops"), [(0.0, True), (0.24, True), (0.25, False), (1.0, False)])
def test_the_share_is_configurable(share, stops):
    followed = watch(max_failed_share=share)
    for iteration in range(1, 4):
        followed.add(iteration, 1, {"failed_episodes": 1, "episodes": 4})
    assert bool(followed.reason()) is stops


def test_every_episode_may_fail_where_the_share_is_one():
    followed = watch(max_failed_share=1.0)
    for iteration in range(1, 4):
        followed.add(iteration, 1, {"failed_episodes": 4, "episodes": 4, "critic_loss": math.nan})
    assert not followed.reason()


def test_critics_that_are_not_finite():
    followed = watch()
    for iteration, loss in enumerate((math.nan, 1.0, math.inf), start=1):
        followed.add(iteration, 1, {"critic_loss": loss})
    assert followed.reason().startswith("critic_loss was not finite in 2 of the last 3 iterations")
    followed.add(4, 1, {"critic_loss": 1.0})
    assert not followed.reason()


def test_gradients_that_are_dropped():
    """The first one is a warning. More than half of the window's stop the run; without a number of environments, none."""
    followed = FailureWatch(ENV, ReportConfig(failure_window=3), num_envs=4)
    unknown = FailureWatch(ENV, ReportConfig(failure_window=3))
    said = [followed.add(i, 10, {"dropped_gradients": n}) for i, n in enumerate((1, 2, 2), start=1)]
    assert said[0].startswith("warning: in iteration 1 the gradient of 1 environment was not finite and was left out:")
    assert said[1:] == ["", ""] and not followed.reason() and followed.healthy
    followed.add(4, 10, {"dropped_gradients": 4})
    assert followed.reason().startswith("8 of 12 gradients of environments were not finite in the last 3 iterations")
    assert not followed.healthy
    for iteration in range(1, 4):
        unknown.add(iteration, 10, {"dropped_gradients": 4})
    assert not unknown.reason(final=True) and unknown.healthy


def test_one_iteration_may_warn_of_both():
    said = watch().add(1, 10, {"dropped_gradients": 1, "failed_episodes": 1}).split("\n")
    assert len(said) == 2 and "an environment failed" in said[0] and "the gradient of 1 environment" in said[1]


def test_algorithms_without_these_metrics_never_fail():
    followed = watch()
    for iteration in range(1, 9):
        assert not followed.add(iteration, 10, {"reward": 1.0})
    assert not followed.reason(final=True)


def test_the_first_failure_names_the_culprit():
    followed = watch()
    said = followed.add(7, 1, {"failed_episodes": 1, "episodes": 1, "failed_env": 3, "failed_leaf": 1})
    assert said.startswith("warning: in iteration 7 environment 3 failed because obs['x'] was not finite: ")
    assert not followed.add(8, 1, {"failed_episodes": 1, "episodes": 1, "failed_env": 5, "failed_leaf": 3})
    assert "at last environment 5 failed because its status had a fatal bit" in followed.reason(final=True)


def test_a_fatal_status_is_named_with_its_remedy():
    followed = watch()
    failed = {"failed_episodes": 1, "episodes": 1, "failed_env": 2, "failed_leaf": 3}
    said = followed.add(1, 1, {**failed, "status/INVALID_PARAMETERS": 0.1, "status/CFL": 0.5, "status/NAN": 0.0})
    assert "its status was INVALID_PARAMETERS (give numbers that make_scene or load accept)" in said


@struct.dataclass
class TrainState(struct.Replaceable):
    """Parts of a training state."""

    weights: dict
    returns: jnp.ndarray
    envs: base.State
    count: jnp.ndarray


def test_what_was_learnt_is_checked():
    key = jnp.zeros(2, jnp.uint32)
    envs = first_state(physics=jnp.zeros(2), obs={"x": jnp.zeros(2)}, metrics={}, key=key)
    state = TrainState(
        weights={"a": jnp.zeros(3), "b": jnp.ones(2)}, returns=jnp.array([jnp.nan, 0.0]), envs=envs, count=jnp.int32(0)
    )
    check = FiniteCheck(state)
    assert check.first_bad(state) == ""
    for bad in (jnp.nan, jnp.inf, -jnp.inf):
        poisoned = state.replace(weights={**state.weights, "b": jnp.array([1.0, bad])})
        assert check.first_bad(poisoned) == ".weights['b']"
    assert check.first_bad(state.replace(envs=envs.replace(physics=jnp.full(2, jnp.nan)))) == ""  # a reset heals it


def test_a_return_of_an_episode_may_become_unknown():
    """As where the run begins episodes at random times."""
    environments = Environments(env=(), state=(), statistics={"mean": jnp.zeros(2)}, episode_return=jnp.zeros(2))
    state = RunState(environments=environments, key=jnp.zeros(2, jnp.uint32))
    check, unknown = FiniteCheck(state), jnp.array([jnp.nan, 0.0])
    assert check.first_bad(state.replace(environments=environments.replace(episode_return=unknown))) == ""
    bad = state.replace(environments=environments.replace(statistics={"mean": unknown}))
    assert check.first_bad(bad) == ".environments.statistics['mean']"


def test_impossible_options_are_refused():
    for share in (-0.1, 1.1, math.nan):
        with pytest.raises(ValueError, match=f"max_failed_share is {share}: give a number between 0 and 1"):
            ReportConfig(max_failed_share=share)
    with pytest.raises(ValueError, match="failure_window is 0: give an integer of at least 1"):
        ReportConfig(failure_window=0)


def test_rows_before_a_gap_are_not_recalled():
    followed = watch()
    rows = {
        "iteration": [1, 3, 4, 5],
        "env_steps": [10, 30, 40, 50],
        "failed_episodes": [4, 4, 4, 1],
        "episodes": [4] * 4,
    }
    followed.recall({name: np.array(values, float) for name, values in rows.items()}, 5)
    assert not followed.reason() and "5 of 8 episodes" in followed.reason(final=True)
    followed.recall({}, 4)
    other = watch()
    other.recall({name: np.array(values, float) for name, values in rows.items()}, 6)  # row 6 is missing
    assert other.healthy and not other.reason(final=True)


def test_a_resumed_process_warns_of_its_own_first_failure():
    followed = watch()
    rows = {"iteration": [1], "env_steps": [10], "failed_episodes": [1], "episodes": [4], "failed_env": [2]}
    followed.recall({name: np.array(values, float) for name, values in rows.items()}, 1)
    failed = {"failed_episodes": 1, "episodes": 4}
    assert followed.add(2, 10, failed).startswith("warning: in iteration 2") and not followed.add(3, 10, failed)
