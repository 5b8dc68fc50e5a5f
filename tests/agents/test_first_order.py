"""Targets of the critics, and the temperature in them: the one before or after its update."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax.agents import sapo
from rewax.agents.actor_critic import make_actor_critic
from rewax.agents.config import FirstOrderConfig
from rewax.agents.first_order import critic_chunk, critic_optimizer, critic_update
from rewax.agents.returns import td_lambda
from rewax.agents.sapo import SAPOConfig, make_sapo
from rewax.agents.temperature import normalized_entropy

CONFIG = SAPOConfig(
    num_envs=4,
    horizon=4,
    initial_temperature=0.5,
    temperature_learning_rate=0.5,  # so large that the temperatures before and after the update differ
    critic_passes=1,
    critic_minibatches=1,
    critic_learning_rate=1e-2,
    actor_widths=(8,),
    critic_widths=(8,),
    vector_features=8,
    stagger_episodes=True,
    differentiate="full",
)
ENV = toys.point_mass()


@pytest.fixture(scope="module")
def start():
    return make_sapo(ENV, CONFIG).init(jax.random.key(0))


@pytest.fixture(scope="module")
def data(start):
    """Rollouts of all environments, as ``train_step`` makes them."""
    networks = make_actor_critic(ENV, CONFIG)

    @jax.jit
    def collect(state):
        key = jax.random.split(state.key)[1]
        envs = state.environments
        return envs.map(
            lambda common, *one: sapo.actor_loss(common.actor_params, common, *one, networks=networks)[1],
            state.common(),
            envs.split(key),
        )

    return collect(start)


@functools.cache
def update(**changes):
    networks = make_actor_critic(ENV, dataclasses.replace(CONFIG, **changes))

    @jax.jit
    def learnt(state, data, reward):
        state, metrics = critic_update(networks, state, data, reward)
        return (state.critic_params, state.critic_opt), metrics

    return learnt


def values(start, obs):
    networks, mean, var = (
        make_actor_critic(ENV, CONFIG),
        *(getattr(start.environments.statistics, name)["x"] for name in ("mean", "variance")),
    )
    one = lambda x: networks.critics.apply(start.critic_params, {"x": (x - mean) / jnp.sqrt(var + 1e-5)})  # noqa: E731
    return np.asarray(jax.jit(jax.vmap(jax.vmap(one)))(obs["x"]))


def expected_loss(start, data, reward, valid=None):
    t = data.transitions
    valid = np.ones(t.reward.shape, bool) if valid is None else valid
    following = np.where(t.terminated, 0.0, values(start, t.next_obs).min(-1))
    one = functools.partial(td_lambda, discount=0.99, lambda_=0.95)
    targets = np.asarray(jax.jit(jax.vmap(one))(reward, following, t.done, valid))
    return np.mean(((values(start, t.obs) - targets[..., None]) ** 2)[valid])


def test_critics_regress_onto_targets_of_the_smaller_value(start, data):
    reward = data.transitions.reward + 0.3
    assert data.transitions.truncated.sum() >= 1
    metrics = update()(start, data, reward)[1]
    np.testing.assert_allclose(metrics["critic_loss"], expected_loss(start, data, reward), rtol=1e-4)


def test_a_failed_step_is_no_sample_and_ends_the_segment_before_it(start, data):
    status = data.transitions.status.at[2, 1].set(1)
    failed = data._replace(
        transitions=data.transitions._replace(
            status=status,
            terminated=data.transitions.terminated.at[2, 1].set(True),
            reward=data.transitions.reward.at[2, 1].set(0.0),
            obs={"x": data.transitions.obs["x"].at[2, 1].set(jnp.nan)},
        )
    )
    valid = np.asarray(status) == 0
    whole = update()(start, failed, failed.transitions.reward)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(whole))
    clean = failed._replace(transitions=failed.transitions._replace(obs=data.transitions.obs))
    expected = expected_loss(start, clean, failed.transitions.reward, valid)
    np.testing.assert_allclose(whole[1]["critic_loss"], expected, rtol=1e-4)
    # the reward of the failed step does not matter
    paid = update()(start, failed, failed.transitions.reward.at[2, 1].set(1e6))
    chex.assert_trees_all_equal(whole, paid)


def test_more_passes_fit_better(start, data):
    reward = data.transitions.reward
    loss = [float(update(critic_passes=n)(start, data, reward)[1]["critic_loss"]) for n in (1, 60)]
    assert loss[1] < 0.5 * loss[0]


def test_targets_take_the_temperature_after_its_update(start, data):
    agent = make_sapo(ENV, CONFIG)
    new, metrics = agent.train_step(start)
    before, after = CONFIG.initial_temperature, float(metrics["temperature"])
    assert abs(after - before) > 0.1
    entropy = data.transitions.aux["entropy"]
    loss = {
        alpha: update()(start, data, data.transitions.reward + alpha * normalized_entropy(entropy, -0.5))[1]
        for alpha in (before, after)
    }
    np.testing.assert_allclose(metrics["critic_loss"], loss[after]["critic_loss"], rtol=1e-4)
    assert abs(float(loss[before]["critic_loss"] / loss[after]["critic_loss"]) - 1) > 1e-3
    assert int(new.iteration) == 1


def test_entropy_is_a_sample_of_its_own(start, data):
    """Minus the log probability of the taken action would be a function of the action."""
    t = data.transitions
    networks = make_actor_critic(ENV, CONFIG)
    distribution = jax.vmap(
        jax.vmap(
            lambda obs: networks.action_distribution(start.actor_params, start.environments.statistics, {"x": obs})
        )
    )(t.obs["x"])
    raw = np.arctanh(np.clip(np.asarray(t.action, np.float64), -1 + 1e-7, 1 - 1e-7))
    std = np.exp(np.asarray(distribution.log_std))
    log_prob = -0.5 * ((raw - distribution.mean) / std) ** 2 - np.log(std * np.sqrt(2 * np.pi))
    of_the_action = -(log_prob - np.log1p(-(np.tanh(raw) ** 2))).sum(-1)
    assert np.abs(of_the_action - np.asarray(t.aux["entropy"])).min() > 1e-4


@pytest.mark.parametrize(("asked", "got"), [(None, 256), (4, 4)])
def test_the_chunk_is_the_configurations_or_what_fits(asked, got):
    assert critic_chunk(make_actor_critic(ENV, FirstOrderConfig(critic_chunk=asked))) == got


def test_critics_learning_rate_counts_iterations_not_updates():
    config = FirstOrderConfig(num_iterations=2, critic_passes=1, critic_minibatches=2)
    optimizer = critic_optimizer(make_actor_critic(ENV, config))
    params, sizes = jnp.zeros(1), []
    state = optimizer.init(params)
    for _ in range(6):
        update, state = optimizer.update(jnp.ones(1), state, params)
        sizes.append(-float(update[0]))
    middle = 0.5 * (5e-4 + 1e-5)
    np.testing.assert_allclose(sizes, [5e-4, 5e-4, middle, middle, 1e-5, 1e-5], rtol=1e-3)
