"""Critics whose targets have a large mean learn the mean first: why SAC starts slowly on returns of thousands."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax.agents.actor_critic import make_actor_critic
from rewax.agents.sac import SACConfig

SIZE = 70.0
"""About the standard deviation of the targets around their mean, and of SAC's targets on CartpoleSwingUp."""
MEAN = -1000.0
NUM_UPDATES, BATCH, LEARNING_RATE = 500, 64, 1e-3
CLIP, NO_CLIP = 0.5, 1e9


def targets(x, action, mean, size):
    """A mean plus a function of observation and action."""
    return mean + size * (jnp.sin(2.0 * x[:, 0]) + action[:, 0] * x[:, 0])


@functools.cache
def fitted(mean, size, max_grad_norm):
    """Mean and standard deviation of a critic's values after ``NUM_UPDATES``; their correlation with the targets."""
    return {name: float(value) for name, value in _program(max_grad_norm)(mean, size).items()}


@functools.cache
def _program(max_grad_norm):
    config = SACConfig(
        actor_widths=(8,), critic_widths=(32,), vector_features=32, max_grad_norm=max_grad_norm,
        critic_learning_rate=LEARNING_RATE,
    )  # fmt: skip
    networks = make_actor_critic(toys.point_mass(), config)

    def draw(key):
        x_key, action_key = jax.random.split(key)
        return jax.random.normal(x_key, (BATCH, 1)), jax.random.uniform(action_key, (BATCH, 1), minval=-1.0)

    def loss(params, x, action, target):
        return jnp.mean((networks.action_values(params, {"x": x}, action) - target[:, None]) ** 2)

    @jax.jit
    def fit(mean, size):
        key = jax.random.key(0)
        params = networks.critics.init(key, {"x": jnp.zeros(1)}, jnp.zeros(1))

        def update(carry, key):
            params, opt = carry
            x, action = draw(key)
            grad = jax.grad(loss)(params, x, action, targets(x, action, mean, size))
            return networks.update(LEARNING_RATE, grad, opt, params), None

        start = (params, networks.optimizer(LEARNING_RATE).init(params))
        (params, _), _ = jax.lax.scan(update, start, jax.random.split(key, NUM_UPDATES))
        x, action = draw(jax.random.key(1))
        values, target = networks.action_values(params, {"x": x}, action).mean(axis=-1), targets(x, action, mean, size)
        return {"mean": values.mean(), "std": values.std(), "correlation": jnp.corrcoef(values, target)[0, 1]}

    return fit


@pytest.mark.parametrize("max_grad_norm", [CLIP, NO_CLIP])
def test_while_a_critic_learns_a_large_mean_its_values_are_constant(max_grad_norm):
    """With and without the clip, the values depend neither on states nor on actions, so the actor has no gradient."""
    large = fitted(MEAN, SIZE, max_grad_norm)
    assert 0.01 < large["mean"] / MEAN < 0.1
    assert large["std"] < 1e-3 * SIZE and abs(large["correlation"]) < 0.5


def test_the_clip_slows_the_mean():
    """The gradient grows with the critic. Adam's second moment lags behind it, unless the clip keeps the norm constant."""
    clipped, unclipped = (fitted(MEAN, SIZE, norm)["mean"] / MEAN for norm in (CLIP, NO_CLIP))
    assert 0.5 * unclipped < clipped < 0.95 * unclipped


def test_without_the_mean_the_same_targets_are_learnt_under_the_clip():
    centred = fitted(0.0, SIZE, CLIP)
    assert centred["std"] > 0.1 * SIZE and centred["correlation"] > 0.6


def test_normalised_targets_are_learnt_together_with_their_mean():
    """The targets are divided by their root mean square, as with ``normalize_rewards``."""
    scale = (MEAN**2 + SIZE**2) ** 0.5
    normalised = fitted(MEAN / scale, SIZE / scale, CLIP)
    np.testing.assert_allclose(normalised["mean"], MEAN / scale, rtol=0.02)
    assert normalised["correlation"] > 0.8


def test_the_mean_moves_at_the_rate_of_adam_whatever_its_size():
    """Adam moves a parameter by about its learning rate per update, so large means take many updates."""
    near, far = fitted(MEAN, SIZE, CLIP)["mean"], fitted(4.0 * MEAN, SIZE, CLIP)["mean"]
    np.testing.assert_allclose(near, far, rtol=0.03)
