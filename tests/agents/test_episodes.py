"""Metrics of episodes: ended and failed episodes, bits of the status."""

import jax.numpy as jnp
import numpy as np

from rewax.agents.episodes import episode_metrics, running_returns
from rewax.agents.rollout import Transition
from rewax.status import Status

REWARD = np.arange(8.0).reshape(2, 4)


def transitions(status, terminated, truncated=None):
    zeros = jnp.zeros((2, 4))
    return Transition(
        obs={"x": zeros[..., None]},
        action=zeros[..., None],
        reward=jnp.asarray(REWARD),
        next_obs={"x": zeros[..., None]},
        terminated=jnp.asarray(terminated, bool),
        truncated=jnp.zeros((2, 4), bool) if truncated is None else jnp.asarray(truncated, bool),
        status=jnp.asarray(status, jnp.int32),
        failed_leaf=jnp.where(jnp.asarray(status) & 1, 3, -1),
        metrics={"height": jnp.asarray(REWARD)},
        aux={},
        active=jnp.ones((2, 4), bool),
    )


def metrics_of(t, running=(10.0, 20.0)):
    return {name: np.asarray(value) for name, value in episode_metrics(jnp.asarray(running), t).items()}


def test_every_bit_has_a_counter_of_its_own():
    status = [[0, int(Status.CFL), int(Status.CFL | Status.INVERTED), 0], [int(Status.INACTIVE_NODES), 0, 0, 0]]
    metrics = metrics_of(transitions(status, np.zeros((2, 4))))
    counted = {bit.name: int(metrics[f"status/{bit.name}"]) for bit in Status if bit}
    assert {name: n for name, n in counted.items() if n} == {"CFL": 2, "INVERTED": 1, "INACTIVE_NODES": 1}
    assert metrics["failed_env"] == metrics["failed_leaf"] == -1 and metrics["failed_episodes"] == 0


def test_failures_are_counted_and_the_first_is_named():
    status = [[0, 0, 0, 0], [0, 1, 0, 1]]
    metrics = metrics_of(transitions(status, [[0, 0, 0, 0], [0, 1, 0, 1]]))
    assert metrics["failed_episodes"] == 2 and metrics["episodes"] == 2
    assert metrics["failed_env"] == 1 and metrics["failed_leaf"] == 3
    assert np.isnan(metrics["return"])  # a failed episode has no return


def test_the_return_is_the_mean_over_the_episodes_that_ended_well():
    status = [[0, 0, 1, 0], [0, 0, 0, 0]]
    metrics = metrics_of(transitions(status, [[0, 0, 1, 1], [0, 1, 0, 0]]))
    np.testing.assert_allclose(metrics["return"], np.mean([REWARD[0, 3], 20 + REWARD[1, :2].sum()]))
    np.testing.assert_allclose(metrics["reward"], REWARD.mean())
    np.testing.assert_allclose(metrics["env/height"], np.delete(REWARD, 2).mean())  # but for the failed step


def test_running_returns_start_anew_and_nan_stays_unknown_until_the_end():
    t = transitions(np.zeros((2, 4), int), [[0, 1, 0, 0], [0, 0, 1, 0]])
    running, finished = running_returns(jnp.array([5.0, jnp.nan]), t)
    np.testing.assert_allclose(running, [2 + 3, 7])
    np.testing.assert_allclose(finished, [[np.nan, 6, np.nan, np.nan], [np.nan] * 4])
