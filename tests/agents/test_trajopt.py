"""TrajOpt: one sequence for all initial states, indexed by the step, clipped to the action bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from agent_cases import ENV, agent, trained

from rewax import struct
from rewax.agents.trajopt import TrajOptConfig, make_trajopt
from rewax.training.evaluation.episodes import evaluate_actions, make_evaluate
from rewax.training.evaluation.recording import record


def test_it_finds_the_best_sequence():
    """Initial positions are uniform in [0.5, 1.5]: the best sequence moves their mean from 1 to 0 in two steps."""
    state, _ = trained("trajopt")
    means = 1.0 + 0.5 * np.cumsum(state.actions[:, 0])
    np.testing.assert_allclose(means, [0.5, 0.0, 0.0, 0.0, 0.0], atol=0.12)


def test_evaluation_plays_it_in_order():
    state, _ = trained("trajopt")
    marked = state.replace(actions=jnp.linspace(-1.0, 1.0, 5)[:, None])
    key = jax.random.key(0)
    played = make_evaluate(ENV, agent("trajopt").policy, 8)(marked, key)
    np.testing.assert_allclose(played["returns"], evaluate_actions(ENV, marked.actions, key, 8)["returns"], rtol=1e-6)
    recording = record(ENV, agent("trajopt").policy, marked, key)
    assert recording.particles is not None
    moved = np.diff(recording.particles[:, 0, 0])  # the cloud moves with the point
    np.testing.assert_allclose(moved, 0.5 * marked.actions[:, 0], atol=1e-6)


def test_actions_stay_within_their_bounds():
    config = TrajOptConfig(num_envs=2, learning_rate=5.0)
    eager = make_trajopt(ENV, config)
    state, _ = eager.train_step(eager.init(jax.random.key(0)))
    assert float(jnp.abs(state.actions).max()) == 1.0


def test_the_return_is_that_of_the_episodes_that_the_sequence_began_with():
    """Episodes that begin anew within an iteration meet the middle of the sequence."""

    class Falling(toys.PointMass):
        def step(self, state, action):
            new = super().step(state, action)
            return new.replace(terminated=new.obs["x"][0] < 0.6)

    env = struct.dataclass(Falling)(gain=jnp.float32(0.5))
    eager = make_trajopt(env, TrajOptConfig(num_envs=16, learning_rate=1e-6))
    state = eager.init(jax.random.key(0)).replace(actions=jnp.full((5, 1), -0.4))
    new, metrics = jax.jit(eager.train_step)(state)
    assert metrics["episodes"] == 16 and int(new.env_steps) == 80
    assert metrics["return"] == pytest.approx(-float(metrics["actor_loss"]), rel=1e-5)


def test_it_plays_whole_episodes_only():
    with pytest.raises(ValueError, match="horizon is 8: TrajOpt plays whole episodes, give 0"):
        TrajOptConfig(horizon=8)
