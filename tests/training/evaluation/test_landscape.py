"""The return around a policy: the middle is the policy itself, and directions are as long as the parameters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_cases import ENV, agent, trained

from rewax.training.evaluation.episodes import evaluate_actions, make_evaluate
from rewax.training.evaluation.landscape import direction, landscape


def test_a_direction_is_as_long_as_each_array():
    params = {"a": jnp.array([3.0, 4.0]), "b": jnp.zeros(3)}
    drawn = direction(jax.random.key(0), params)
    np.testing.assert_allclose(jnp.linalg.norm(drawn["a"]), 5.0, rtol=1e-6)
    np.testing.assert_array_equal(drawn["b"], 0.0)


@pytest.mark.parametrize("name", ["sapo", "trajopt"])
def test_the_middle_is_the_policy_and_a_trained_one_is_near_the_top(name):
    state, _ = trained(name)
    key = jax.random.key(3)
    found = landscape(ENV, agent(name).policy, state, key, size=5, span=1.0, num_episodes=8)
    episodes = jax.random.split(key, 3)[2]
    own = make_evaluate(ENV, agent(name).policy, 8)(state, episodes, deterministic=True)["mean"]
    np.testing.assert_allclose(found.returns[2, 2], own, rtol=1e-5)
    assert found.returns.shape == (5, 5) and found.returns[2, 2] > np.median(found.returns)
    if name == "trajopt":
        u = direction(jax.random.split(key, 3)[0], state.actions)
        moved = evaluate_actions(ENV, state.actions + found.offsets[3] * u, episodes, 8)["mean"]
        np.testing.assert_allclose(found.returns[3, 2], moved, rtol=1e-5)


def test_what_cannot_be_is_one_sentence():
    state, _ = trained("trajopt")
    policy, key = agent("trajopt").policy, jax.random.key(0)
    with pytest.raises(ValueError, match="size is 4: give an odd number from 3 on"):
        landscape(ENV, policy, state, key, size=4)
    with pytest.raises(ValueError, match="span is 0: give a positive number"):
        landscape(ENV, policy, state, key, span=0)
    with pytest.raises(ValueError, match="has neither actor_params nor actions: there is nothing to shift"):
        landscape(ENV, policy, {"x": 1}, key)
