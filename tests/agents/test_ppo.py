"""PPO: its loss written out in numpy, its advantages, and the learning rate that follows the divergence."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from agent_cases import CASES, ENV, agent, trained
from scipy import stats

from rewax.agents.actor_critic import make_actor_critic
from rewax.agents.ppo import Batch, PPOConfig, ppo_loss, shuffled, update
from rewax.agents.registry import make_agent
from rewax.agents.returns import td_lambda

CONFIG = CASES["ppo"].config


NETWORKS = make_actor_critic(ENV, CONFIG)
FIXED = dataclasses.replace(CONFIG, target_kl=None, epochs=1, minibatches=1, actor_learning_rate=1e-3)


@functools.cache
def parameters():
    """Of an actor and of critics."""
    keys = jax.random.split(jax.random.key(0))
    return tuple(
        jax.jit(part.init)(key, {"x": jnp.zeros(1)})
        for part, key in zip((NETWORKS.network, NETWORKS.critics), keys, strict=True)
    )


@jax.jit
def loss_of(params, batch):
    return ppo_loss(params, networks=NETWORKS, batch=batch)


@jax.jit
def gradients_of(params, batch):
    return jax.grad(ppo_loss, has_aux=True)(params, networks=NETWORKS, batch=batch)[0]


@jax.jit
def policies(params, obs):
    return jax.vmap(lambda o: NETWORKS.distribution(params, o))(obs)


def batch_of(params, key, n=6):
    keys = jax.random.split(key, 4)
    obs = {"x": jax.random.normal(keys[0], (n, 1))}
    now = policies(params, obs)
    mean, log_std = now.mean + 0.1, now.log_std - 0.2
    raw = mean + jnp.exp(log_std) * jax.random.normal(keys[1], mean.shape)
    log_prob = stats.norm.logpdf(raw, mean, np.exp(log_std)).sum(-1) - 2 * (
        np.log(2.0) - raw - jax.nn.softplus(-2 * raw)
    ).sum(-1)
    batch = Batch(
        obs=obs,
        raw=raw,
        mean=mean,
        log_std=log_std,
        log_prob=jnp.asarray(log_prob, jnp.float32),
        advantage=jax.random.normal(keys[2], (n,)),
        target=jax.random.normal(keys[3], (n,)),
        weight=jnp.ones(n).at[2].set(0.0),
    )
    return batch, now


def test_the_loss_is_the_clipped_surrogate_and_the_values_error():
    actor, critic = parameters()
    batch, now = batch_of(actor, jax.random.key(2))
    loss, metrics = loss_of((actor, critic), batch)
    counts = np.asarray(batch.weight, bool)
    new, old = (stats.norm.logpdf(batch.raw, policy.mean, np.exp(policy.log_std)).sum(-1) for policy in (now, batch))
    ratio, advantage = np.exp(new - old), np.asarray(batch.advantage)
    gain = np.minimum(ratio * advantage, np.clip(ratio, 0.8, 1.2) * advantage)[counts].mean()
    value = np.asarray(jax.jit(NETWORKS.values)(critic, batch.obs))[:, 0]
    error = 0.5 * ((value - batch.target) ** 2)[counts].mean()
    np.testing.assert_allclose(metrics["actor_loss"], -gain, rtol=1e-4)
    np.testing.assert_allclose(metrics["critic_loss"], error, rtol=1e-4)
    np.testing.assert_allclose(loss, -gain + 4.0 * error, rtol=1e-4)
    s0, s1 = np.exp(batch.log_std), np.exp(now.log_std)
    kl = (np.log(s1 / s0) + (s0**2 + 0.1**2) / (2 * s1**2) - 0.5).sum(-1)[counts].mean()
    np.testing.assert_allclose(metrics["kl"], kl, rtol=1e-3)


@pytest.mark.parametrize("advantage", [-1.0, 1.0])
def test_samples_of_very_different_probability_leave_the_gradient_finite(advantage):
    """Of a masked one nothing counts; of one that counts, the gradient has the direction of the plain one."""
    actor, critic = parameters()
    batch, now = batch_of(actor, jax.random.key(2))
    batch = batch._replace(advantage=jnp.full(6, advantage))

    def gradient(batch):
        return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(gradients_of((actor, critic), batch)[0])])

    plain = gradient(batch)
    masked = gradient(batch._replace(log_prob=batch.log_prob.at[2].set(-100.0)))
    np.testing.assert_allclose(masked, plain, rtol=1e-5)
    assert np.abs(plain).max() > 0.0

    only = batch._replace(weight=jnp.zeros(6).at[1].set(1.0))
    far = gradient(only._replace(log_prob=only.log_prob.at[1].set(-100.0)))
    assert np.all(np.isfinite(far))
    if advantage > 0:
        np.testing.assert_array_equal(far, 0.0)  # clipped
    else:
        near = gradient(only._replace(log_prob=jax.vmap(type(now).log_prob_raw)(now, only.raw)))
        np.testing.assert_allclose(far, np.exp(20.0) * near, rtol=1e-4)


def test_the_norms_of_the_gradients_of_actor_and_critic_are_apart():
    state = agent("ppo").init(jax.random.key(0))
    batch, _ = batch_of(state.actor_params, jax.random.key(2))
    grads = gradients_of((state.actor_params, state.critic_params), batch)
    _, metrics = jax.jit(functools.partial(update, NETWORKS))(state, batch)
    for name, grad in zip(("actor_grad_norm", "critic_grad_norm"), grads, strict=True):
        np.testing.assert_allclose(metrics[name], optax.tree.norm(grad), rtol=1e-4)


def gae(reward, value, next_value, done, discount, lambda_):
    """The recursion of Schulman et al. 2016; next_value is 0 where terminated."""
    out, last = np.zeros_like(reward), 0.0
    for t in reversed(range(len(reward))):
        last = reward[t] + discount * next_value[t] - value[t] + discount * lambda_ * (not done[t]) * last
        out[t] = last
    return out


@pytest.mark.parametrize("seed", range(5))
def test_targets_less_values_are_generalised_advantages(x64, seed):
    rng = np.random.default_rng(seed)
    reward, values = rng.normal(size=12), rng.normal(size=13)
    done = rng.random(12) < 0.25
    terminated = done & (rng.random(12) < 0.5)
    value = values[:-1]
    next_value = np.where(terminated, 0.0, np.where(done, rng.normal(size=12), values[1:]))
    targets = td_lambda(*map(jnp.asarray, (reward, next_value, done)), discount=0.9, lambda_=0.8)
    np.testing.assert_allclose(targets - value, gae(reward, value, next_value, done, 0.9, 0.8), rtol=1e-10)


def test_the_learning_rate_follows_the_divergence():
    _, rows = trained("ppo")
    rates = [float(row["learning_rate"]) for row in rows]
    assert len(set(rates)) > 3 and 1e-6 <= min(rates) <= max(rates) <= 1e-2
    fixed = make_agent("ppo", ENV, FIXED)
    _, metrics = fixed.train_step(fixed.init(jax.random.key(0)))
    assert float(metrics["learning_rate"]) == pytest.approx(FIXED.actor_learning_rate)


def test_a_resumed_run_follows_another_fixed_learning_rate():
    slow, fast = FIXED, dataclasses.replace(FIXED, actor_learning_rate=2e-3)
    start = make_agent("ppo", ENV, slow).init(jax.random.key(0))
    (a, _), (b, metrics) = (make_agent("ppo", ENV, config).train_step(start) for config in (slow, fast))
    moved = [
        np.asarray(jax.tree.leaves(new.actor_params)[0] - jax.tree.leaves(start.actor_params)[0]) for new in (a, b)
    ]
    np.testing.assert_allclose(moved[1], 2.0 * moved[0], atol=1e-7)
    assert np.abs(moved[0]).max() > 1e-4 and float(metrics["learning_rate"]) == pytest.approx(2e-3)


def test_minibatches_divide_the_samples():
    with pytest.raises(ValueError, match=r"minibatches is 3, which does not divide num_envs \* horizon = 64"):
        PPOConfig(num_envs=8, horizon=8, minibatches=3)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"actor_learning_rate": 0.05},
            r"actor_learning_rate is 0.05, but learning_rate_range is \(1e-06, 0.01\): give",
        ),
        ({"num_envs": 1, "horizon": 1}, r"num_envs \* horizon is 1: give at least 2"),
    ],
)
def test_what_would_not_train_is_refused(changes, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}"):
        PPOConfig(**changes)
    assert PPOConfig(actor_learning_rate=0.05, target_kl=None).start_only == PPOConfig().start_only - {
        "actor_learning_rate"
    }


def test_every_sample_is_in_one_minibatch_and_keeps_its_fields_together():
    batch = {"a": jnp.arange(12.0).reshape(3, 4), "b": 2.0 * jnp.arange(12.0).reshape(3, 4)[..., None]}
    parts = shuffled(jax.random.key(0), batch, 4)
    assert parts["a"].shape == (4, 3) and parts["b"].shape == (4, 3, 1)
    np.testing.assert_array_equal(np.sort(parts["a"].ravel()), np.arange(12.0))
    np.testing.assert_array_equal(parts["b"][..., 0], 2.0 * parts["a"])
    assert not np.array_equal(parts["a"].ravel(), np.arange(12.0))


def test_an_integer_is_a_learning_rate():
    config = dataclasses.replace(CASES["ppo"].config, actor_learning_rate=1, learning_rate_range=(1e-6, 1.0))
    assert jax.eval_shape(make_agent("ppo", ENV, config).init, jax.random.key(0)).learning_rate.dtype == jnp.float32
