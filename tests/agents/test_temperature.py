"""The temperature: the factor of its loss, and the direction of its update."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_cases import CASES, ENV, agent

from rewax.agents.actor_critic import make_actor
from rewax.agents.temperature import normalized_entropy, temperature_loss, update_temperature

RATE = 0.01
ACTOR = make_actor(ENV, dataclasses.replace(CASES["sapo"].config, weight_decay=0.0))


def updated(start, entropy):
    state = agent("sapo").init(jax.random.key(0)).replace(log_temperature=start)
    state, metrics = update_temperature(ACTOR, state, jnp.float32(entropy), target=-0.5, learning_rate=RATE)
    np.testing.assert_allclose(metrics["temperature"], np.exp(state.log_temperature), rtol=1e-6)
    return state.log_temperature


def test_normalized_entropy_is_zero_at_the_target_and_one_at_its_opposite():
    for size in (0.5, 3.0):
        np.testing.assert_allclose(normalized_entropy(jnp.array([-size, 0.0, size]), -size), [0.0, 0.5, 1.0])


@pytest.mark.parametrize("target", [-0.5, -8.0])
def test_the_loss_has_the_factor_of_the_target(x64, target):
    log_temperature, entropy = jnp.log(0.3), jnp.asarray(1.25)
    slope = jax.grad(temperature_loss)(log_temperature, entropy, target)
    np.testing.assert_allclose(slope, 0.3 * abs(target) * (1.25 - target), rtol=1e-12)
    assert jax.grad(temperature_loss, argnums=1)(log_temperature, entropy, target) == 0.0


@pytest.mark.parametrize(("entropy", "sign"), [(-2.0, 1), (-0.6, 1), (-0.4, -1), (1.0, -1)])
def test_temperature_moves_entropy_towards_its_target(entropy, sign):
    start = jnp.log(jnp.float32(0.7))
    new = updated(start, entropy)
    assert np.sign(new - start) == sign
    np.testing.assert_allclose(abs(new - start), RATE, rtol=1e-3)  # Adam's first step


def test_an_entropy_that_is_not_a_number_changes_nothing():
    start = jnp.float32(0.2)
    new = updated(start, jnp.nan)
    assert new == start
