"""Networks and optimizers built from a configuration."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import toys

from rewax.agents.actor_critic import make_actor_critic
from rewax.agents.config import FirstOrderConfig
from rewax.agents.normalization import init_statistics

CONFIG = FirstOrderConfig(actor_widths=(8,), critic_widths=(8,), vector_features=8, num_critics=3, observation_clip=2.0)
ENV = toys.point_mass()
STATISTICS = init_statistics(ENV.observation_spec).__class__(
    count=jnp.ones(()), mean={"x": jnp.array([1.0])}, variance={"x": jnp.array([4.0])}
)


def test_observations_are_normalised_and_clipped_if_asked_to():
    networks = make_actor_critic(ENV, CONFIG)
    np.testing.assert_allclose(networks.normalize(STATISTICS, {"x": jnp.array([4.0])})["x"], [1.5], rtol=1e-5)
    np.testing.assert_allclose(networks.normalize(STATISTICS, {"x": jnp.array([9e5])})["x"], [2.0])
    raw = make_actor_critic(ENV, dataclasses.replace(CONFIG, normalize_observations=False))
    np.testing.assert_array_equal(raw.normalize(STATISTICS, {"x": jnp.array([9e5])})["x"], [9e5])


def test_distribution_and_values_are_those_of_the_networks():
    networks, obs = make_actor_critic(ENV, CONFIG), {"x": jnp.array([2.0])}
    actor = networks.network.init(jax.random.key(0), obs)
    critics = networks.critics.init(jax.random.key(1), obs)
    distribution = networks.action_distribution(actor, STATISTICS, obs)
    mean, log_std = networks.network.apply(actor, {"x": jnp.array([0.5])})
    np.testing.assert_allclose(distribution.mean, mean, rtol=1e-4)
    np.testing.assert_allclose(distribution.log_std, log_std, rtol=1e-4)
    values = networks.values(critics, {"x": jnp.array([[0.5], [1.0]])})
    assert values.shape == (2, 3)
    np.testing.assert_allclose(values[1], networks.critics.apply(critics, {"x": jnp.array([1.0])}), rtol=1e-5)
