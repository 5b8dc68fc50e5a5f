"""SAPO on a point mass: its gradient, its learning, and isolation of a broken environment."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import toys

from rewax import struct
from rewax.agents import sapo
from rewax.agents.actor_critic import make_actor_critic
from rewax.agents.gradients import per_env_gradients as all_gradients
from rewax.agents.sapo import SAPOConfig, make_sapo
from rewax.envs.base import next_state

HEALTHY, NAN_VALUE, NAN_GRADIENT, ENDING = range(4)
LENGTH = 5
CONFIG = SAPOConfig(
    num_envs=4,
    horizon=4,
    num_iterations=120,
    actor_learning_rate=1e-2,
    critic_learning_rate=5e-3,
    initial_temperature=0.02,
    critic_passes=2,
    critic_minibatches=2,
    actor_widths=(8,),
    critic_widths=(8,),
    vector_features=8,
    stagger_episodes=True,
    differentiate="full",
)
# Noise so small that an action is the tanh of its mean.
CALM = dataclasses.replace(CONFIG, log_std_range=(-20.0, -20.0))


@struct.dataclass
class Faulty(toys.PointMass):
    """A point mass with a first step that fails as ``physics["mode"]`` says; a reset heals it."""

    def reset(self, key):
        state = super().reset(key)
        return state.replace(physics={"x": state.physics, "mode": jnp.int32(HEALTHY)})

    def step(self, state, action):
        mode = state.physics["mode"]
        x = state.physics["x"] + self.gain * jnp.clip(action, -1.0, 1.0)
        x = x + jnp.where(mode == NAN_VALUE, jnp.nan, 0.0)
        flat = mode == NAN_GRADIENT  # adds 0, with the derivative inf * 0
        x = x + jnp.sqrt(jnp.where(flat, 0.0 * x**2, 1.0)) - jnp.where(flat, 0.0, 1.0)
        return next_state(
            state,
            physics={"x": x, "mode": mode},
            obs={"x": x},
            reward=-(x[0] ** 2),
            metrics={"distance": jnp.abs(x[0])},
            episode_length=self.length,
            terminated=mode == ENDING,
        )


ENV = Faulty(gain=jnp.float32(0.5), length=LENGTH)


def prepared(state, modes, counts=(0, 0, 0, 0)):
    """The same run with the given modes and step counts of the environments."""
    envs = state.environments
    physics = {**envs.state.physics, "mode": jnp.array(modes, jnp.int32)}
    env_state = envs.state.replace(physics=physics, step_count=jnp.array(counts, jnp.int32))
    return state.replace(environments=envs.replace(state=env_state))


def raw(leaf):
    return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)


def assert_same_bits(a, b):
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(raw(x), raw(y)), a, b)


def finite(tree):
    return all(np.isfinite(raw(leaf)).all() for leaf in jax.tree.leaves(tree))


@pytest.fixture(scope="module")
def agent():
    return make_sapo(ENV, CONFIG)


@pytest.fixture(scope="module")
def start(agent):
    return agent.init(jax.random.key(0))


def per_env_gradients(config):
    """Jitted: loss, data and gradient of every environment, with the keys of ``train_step``."""
    networks = make_actor_critic(ENV, config)

    @jax.jit
    def gradients(state):
        loss = functools.partial(sapo.actor_loss, networks=networks)
        losses, data, grads = all_gradients(
            loss, state.actor_params, state.common(), state.environments, jax.random.split(state.key)[1]
        )
        return (losses, data), grads

    return gradients


@pytest.fixture(scope="module")
def gradients():
    return per_env_gradients(CONFIG)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_learns_and_compiles_once(agent, seed):
    state, rows = agent.init(jax.random.key(seed)), []
    for _ in range(CONFIG.num_iterations):
        state, metrics = agent.train_step(state)
        rows.append(metrics)
    reward, returns = (np.array([r[name] for r in rows]) for name in ("reward", "return"))
    assert reward[:2].mean() < -0.35  # the point starts about 1 away and is left there, on average
    assert reward[-20:].mean() > -0.2  # two steps to 0, and a little noise
    assert np.nanmean(returns[-20:]) > -1.0
    assert int(state.iteration) == 120 and int(state.env_steps) == 120 * 16
    assert sum(int(r["failed_episodes"] + r["dropped_gradients"]) for r in rows) == 0
    mean = agent.policy(state, {"x": jnp.array([1.0])}, jax.random.key(0), deterministic=True)
    assert mean.shape == (1,) and mean[0] < -0.5
    assert agent.train_step._cache_size() == 1  # nothing it returns differs in type from what it takes


def objective(params, state, i, data, config):
    """Minus the soft return per step of environment i, written out for actions without noise."""
    parts = make_actor_critic(ENV, config)
    mean, var = state.environments.statistics.mean["x"], state.environments.statistics.variance["x"]

    def seen(x):
        return {"x": (x - mean) / jnp.sqrt(var + 1e-5)}

    env = jax.tree.map(lambda a: a[i], state.environments.state.physics)
    x, mode, count = env["x"], env["mode"], state.environments.state.step_count[i]
    total, weight = 0.0, 1.0
    for t in range(config.horizon):
        raw_action = parts.network.apply(params, seen(x))[0]
        action = jnp.tanh(raw_action)
        # log det of tanh, all of the entropy that varies without noise
        entropy = jnp.sum(jnp.log(1 - action**2))
        x = x + 0.5 * action
        bonus = jnp.exp(state.log_temperature) * entropy * 0.5 / 0.5
        of_return = weight if config.entropy_in_return else float(config.entropy_in_loss)  # not discounted
        total = total + weight * -(x[0] ** 2) + of_return * bonus
        count, ended = count + 1, mode == ENDING
        done = ended | (count >= LENGTH)
        value = jnp.mean(parts.critics.apply(state.critic_params, seen(x)))  # of where it leads, before any reset
        end_value = jnp.where(ended, 0.0, weight * config.discount * value)
        last = t == config.horizon - 1
        total = total + (end_value if last else jnp.where(done, end_value, 0.0))
        weight = jnp.where(done, 1.0, weight * config.discount)
        if not last:
            x = jnp.where(done, data.transitions.obs["x"][i, t + 1], x)  # a fresh episode is drawn, not derived
        count, mode = jnp.where(done, 0, count), jnp.where(done, HEALTHY, mode)
    return -total / config.horizon


@pytest.mark.parametrize(("in_return", "in_loss"), [(True, True), (False, True), (False, False)])
def test_gradient_is_that_of_the_objective_written_out(start, in_return, in_loss):
    config = dataclasses.replace(CALM, entropy_in_return=in_return, entropy_in_loss=in_loss)
    temperature = jnp.log(jnp.float32(0.7))
    # one within an episode, one truncated at t = 1, one at the last step, one terminated at t = 0
    state = prepared(start, [HEALTHY, HEALTHY, HEALTHY, ENDING], [0, 3, 1, 0]).replace(log_temperature=temperature)
    (loss, data), got = per_env_gradients(config)(state)
    np.testing.assert_array_equal(data.transitions.truncated[1], [False, True, False, False])
    np.testing.assert_array_equal(data.transitions.truncated[2], [False, False, False, True])
    np.testing.assert_array_equal(data.transitions.terminated[3], [True, False, False, False])

    @jax.jit
    def expected(params):
        one = jax.value_and_grad(objective)
        return jax.vmap(lambda i: one(params, state, i, data, config))(jnp.arange(4))

    value, slope = expected(state.actor_params)
    jax.tree.map(lambda g, e: np.testing.assert_allclose(g, e, rtol=2e-3, atol=2e-5), got, slope)
    if not (in_return or in_loss):  # without the bonus' random part the value is known too
        np.testing.assert_allclose(loss, value, rtol=1e-5)


def test_train_step_follows_the_mean_of_the_environments_gradients(agent, start, gradients):
    (losses, data), grads = gradients(start)
    new, metrics = agent.train_step(start)
    grad = jax.tree.map(lambda g: g.mean(axis=0), grads)
    np.testing.assert_allclose(metrics["actor_loss"], losses.mean(), rtol=1e-5)
    np.testing.assert_allclose(metrics["actor_grad_norm"], optax.global_norm(grad), rtol=1e-4)
    np.testing.assert_allclose(metrics["reward"], data.transitions.reward.mean(), rtol=1e-5)
    np.testing.assert_allclose(metrics["env/distance"], data.transitions.metrics["distance"].mean(), rtol=1e-5)
    optimizer = make_actor_critic(ENV, CONFIG).actor_optimizer
    updates, _ = jax.jit(optimizer.update)(grad, start.actor_opt, start.actor_params)
    expected = optax.apply_updates(start.actor_params, updates)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-4), new.actor_params, expected)
    # statistics: of all observations
    x = np.concatenate([raw(start.environments.state.obs["x"]), raw(data.transitions.obs["x"]).reshape(-1, 1)])
    np.testing.assert_allclose(new.environments.statistics.mean["x"], x.sum(0) / (len(x) + 1), rtol=1e-5)


def test_return_is_that_of_the_episodes_that_ended(agent, start, gradients):
    state = prepared(start, [HEALTHY] * 4, [0, 0, 0, 2])
    returns = jnp.array([1.0, 2.0, 3.0, 4.0])
    state = state.replace(environments=state.environments.replace(episode_return=returns))
    (_, data), _ = gradients(state)
    new, metrics = agent.train_step(state)
    reward = raw(data.transitions.reward)
    np.testing.assert_allclose(metrics["return"], 4.0 + reward[3, :3].sum(), rtol=1e-5)
    np.testing.assert_allclose(
        new.environments.episode_return, [*([1, 2, 3] + reward[:3].sum(1)), reward[3, 3]], rtol=1e-5
    )


@pytest.mark.parametrize(("mode", "failures"), [(NAN_VALUE, 1), (NAN_GRADIENT, 0)])
def test_a_broken_environment_is_dropped_counted_and_touches_no_other(agent, start, gradients, mode, failures):
    healthy, broken = prepared(start, [HEALTHY] * 4), prepared(start, [HEALTHY, HEALTHY, mode, HEALTHY])
    others = np.array([0, 1, 3])
    (clean, broke), keep = (
        (gradients(s) for s in (healthy, broken)),
        lambda tree: jax.tree.map(lambda a: a[others], tree),
    )
    assert_same_bits(keep(clean), keep(broke))  # losses, trajectories and gradients
    assert finite(broke[0]) and not finite(jax.tree.map(lambda g: g[2], broke[1]))  # only its gradient is bad
    (reference, good), (new, metrics) = agent.train_step(healthy), agent.train_step(broken)
    assert_same_bits(keep(reference.environments.state), keep(new.environments.state))
    assert int(metrics["dropped_gradients"]) == 1 and int(good["dropped_gradients"]) == 0
    assert int(metrics["failed_episodes"]) == failures and int(good["failed_episodes"]) == 0
    mean = jax.tree.map(lambda g: g.mean(axis=0), keep(broke[1]))
    np.testing.assert_allclose(metrics["actor_grad_norm"], optax.global_norm(mean), rtol=1e-4)
    np.testing.assert_allclose(metrics["actor_loss"], broke[0][0][others].mean(), rtol=1e-5)
    assert finite(new.actor_params) and finite(new.critic_params) and finite(new.environments.statistics)
    # A failure ends the episode at once; what is merely not differentiable goes on to the time limit.
    np.testing.assert_array_equal(broke[0][1].transitions.terminated[2], np.arange(4) == (0 if failures else -1))
    for _ in range(3):
        new, metrics = agent.train_step(new)
    assert finite(new.actor_params) and int(metrics["failed_episodes"]) == int(metrics["dropped_gradients"]) == 0


def test_nothing_is_learnt_from_environments_that_are_all_broken(agent, start):
    new, metrics = agent.train_step(prepared(start, [NAN_VALUE] * 4))
    assert int(metrics["dropped_gradients"]) == int(metrics["failed_episodes"]) == 4
    assert metrics["actor_grad_norm"] == 0.0 and np.isfinite(metrics["critic_loss"])
    lr, decay = CONFIG.actor_learning_rate, CONFIG.weight_decay
    for a, b in zip(jax.tree.leaves(new.actor_params), jax.tree.leaves(start.actor_params), strict=True):
        np.testing.assert_allclose(a, (1 - lr * decay) * b, rtol=1e-5)


def test_environments_start_apart_if_asked_to(agent):
    counts = np.concatenate([raw(agent.init(jax.random.key(s)).environments.state.step_count) for s in range(10)])
    np.testing.assert_array_equal(np.unique(counts), np.arange(LENGTH))
    one, other = (raw(agent.init(jax.random.key(seed)).environments.state.obs["x"]) for seed in (5, 6))
    assert not np.array_equal(one, other)


def test_switches_that_keep_temperature_statistics_and_starts():
    config = dataclasses.replace(
        CONFIG, learn_temperature=False, normalize_observations=False, stagger_episodes=False, initial_temperature=0.3
    )
    agent = make_sapo(ENV, config)
    state = agent.init(jax.random.key(0))
    np.testing.assert_array_equal(state.environments.state.step_count, np.zeros(4))
    new, metrics = agent.train_step(state)
    assert new.log_temperature == state.log_temperature
    np.testing.assert_allclose(metrics["temperature"], 0.3, rtol=1e-6)
    assert_same_bits(new.environments.statistics, state.environments.statistics)
    assert new.environments.statistics.count == 1.0 and new.environments.statistics.mean["x"] == 0.0


@pytest.mark.parametrize("differentiate", ["checkpointed", "none"])
def test_ways_of_differentiation(start, gradients, differentiate):
    (losses, _), grads = gradients(start)
    (again, _), other = per_env_gradients(dataclasses.replace(CONFIG, differentiate=differentiate))(start)
    if differentiate == "checkpointed":
        np.testing.assert_allclose(again, losses, rtol=1e-5)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), other, grads)
    else:
        assert optax.global_norm(other) == 0.0 < optax.global_norm(grads)


def test_the_entropy_is_held_at_its_target():
    config = dataclasses.replace(CONFIG, num_iterations=600, temperature_learning_rate=0.02)
    held = make_sapo(toys.point_mass(), config)
    state, entropy = held.init(jax.random.key(0)), []
    for _ in range(600):
        state, metrics = held.train_step(state)
        entropy.append(metrics["entropy"])
    target = -config.target_entropy_scale
    assert abs(float(np.mean(entropy[-100:])) - target) < 0.1 * abs(target)
