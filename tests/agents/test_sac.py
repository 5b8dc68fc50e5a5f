"""SAC: its losses, the warm-up, the target entropy, and the buffer, which is not copied."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_cases import CASES, ENV, agent, trained

from rewax.agents import replay as replays
from rewax.agents import sac
from rewax.agents.actor_critic import make_actor_critic
from rewax.agents.replay import Sample
from rewax.agents.sac import SACConfig

CONFIG = CASES["sac"].config
NETWORKS = make_actor_critic(ENV, CONFIG)


@pytest.fixture(scope="module")
def start():
    return agent("sac").init(jax.random.key(0))


def batch(valid):
    n = len(valid)
    keys = jax.random.split(jax.random.key(2), 4)
    return Sample(
        obs={"x": jax.random.normal(keys[0], (n, 1))},
        action=jnp.tanh(jax.random.normal(keys[1], (n, 1))),
        reward=jax.random.normal(keys[2], (n,)),
        discount=jnp.array([0.97, 0.0, 0.5, 0.9][:n]),
        next_obs={"x": jax.random.normal(keys[3], (n, 1))},
        valid=jnp.asarray(valid),
    )


def test_critics_regress_onto_the_soft_target_of_the_smaller_value(start):
    data, key = batch([True, True, False, True]), jax.random.key(4)

    @jax.jit
    @jax.vmap
    def error(one, key):
        action, log_prob = NETWORKS.distribution(start.actor_params, one.next_obs).sample_and_log_prob(key)
        soft = NETWORKS.critics.apply(start.target_params, one.next_obs, action).min() - 0.1 * log_prob
        target = one.reward + one.discount * soft
        return jnp.mean((NETWORKS.critics.apply(start.critic_params, one.obs, one.action) - target) ** 2)

    loss = jax.jit(lambda params: sac.critic_loss(params, networks=NETWORKS, state=start, batch=data, key=key)[0])
    errors = error(data, jax.random.split(key, 4))
    np.testing.assert_allclose(loss(start.critic_params), np.mean([errors[0], errors[1], errors[3]]), rtol=1e-4)


def test_the_actor_ascends_the_soft_value(start):
    data, key = batch([True, False]), jax.random.key(4)
    loss, metrics = jax.jit(lambda params: sac.actor_loss(params, networks=NETWORKS, state=start, batch=data, key=key))(
        start.actor_params
    )

    @jax.jit
    def first(obs, key):
        action, log_prob = NETWORKS.distribution(start.actor_params, obs).sample_and_log_prob(key)
        return log_prob, NETWORKS.critics.apply(start.critic_params, obs, action).min()

    log_prob, value = first({"x": data.obs["x"][0]}, jax.random.split(key, 2)[0])
    np.testing.assert_allclose(loss, 0.1 * log_prob - value, rtol=1e-4)
    np.testing.assert_allclose(metrics["entropy"], -log_prob, rtol=1e-5)


def test_nothing_is_learnt_while_actions_are_random(start):
    config = dataclasses.replace(CONFIG, warmup_steps=8)
    warming = sac.make_sac(ENV, config)
    state, metrics = warming.train_step(agent("sac").init(jax.random.key(0)))
    jax.tree.map(np.testing.assert_array_equal, state.actor_params, start.actor_params)
    jax.tree.map(np.testing.assert_array_equal, state.target_params, start.target_params)
    unknown = {name for name, value in metrics.items() if np.isnan(value)} - {"return"}
    assert unknown == {"actor_loss", "actor_grad_norm", "entropy", "value"}
    first = jax.random.split(jax.random.split(start.key, 3)[2], config.updates)[0]
    networks = make_actor_critic(ENV, config)
    _, of_first = jax.jit(lambda state: sac.update(networks, state.replay, None, state, first))(state)
    np.testing.assert_allclose(metrics["critic_loss"], of_first["critic_loss"], rtol=1e-5)
    actions = np.asarray(state.replay.steps.action[:4]).ravel()
    assert np.abs(actions).max() < 1.0 and np.std(actions) == pytest.approx(1 / np.sqrt(3), abs=0.2)
    for _ in range(2):
        state, metrics = warming.train_step(state)
    assert all(np.isfinite(metrics[name]) for name in unknown)
    assert any(
        np.any(leaf != 0) for leaf in jax.tree.leaves(jax.tree.map(np.subtract, state.actor_params, start.actor_params))
    )


def test_the_entropy_goes_to_its_target():
    _, rows = trained("sac")
    entropy = np.array([row["entropy"] for row in rows])
    target = -CONFIG.target_entropy_scale
    assert abs(entropy[-50:].mean() - target) < 0.1, entropy[-50:].mean()


def test_with_normalised_rewards_their_unit_does_not_matter(start):
    config = dataclasses.replace(CONFIG, normalize_rewards=True)
    networks, key = make_actor_critic(ENV, config), jax.random.key(5)
    state, _ = sac.make_sac(ENV, config).train_step(agent("sac").init(jax.random.key(0)))
    small = state.replay
    large = small.replace(steps=small.steps._replace(reward=1024.0 * small.steps.reward))
    update = jax.jit(lambda replay, scale: sac.update(networks, replay, scale, state, key))
    (one, _), (other, _) = (update(replay, replays.return_scale(replay, config.discount)) for replay in (small, large))
    jax.tree.map(np.testing.assert_array_equal, one.critic_params, other.critic_params)
    jax.tree.map(np.testing.assert_array_equal, one.actor_params, other.actor_params)
    raw, _ = update(large, None)
    assert any(jax.tree.leaves(jax.tree.map(lambda a, b: bool((a != b).any()), raw.critic_params, one.critic_params)))


def test_the_buffer_is_changed_in_place():
    state = agent("sac").init(jax.random.key(0))
    old = state.replay.steps.reward
    agent("sac").train_step(state)
    assert old.is_deleted()


def test_stored_steps_end_where_environments_restart():
    """As after a change of the simulation, with which a checkpoint's episodes cannot go on."""
    state, _ = agent("sac").train_step(agent("sac").init(jax.random.key(0)))
    horizon = CONFIG.horizon
    before, new = state.replay, state.restarted(CONFIG)
    assert not np.all(before.steps.done[horizon - 1]) and np.all(new.replay.steps.done[horizon - 1])
    np.testing.assert_array_equal(new.replay.steps.done[: horizon - 1], before.steps.done[: horizon - 1])
    assert np.any(new.environments.state.physics != state.environments.state.physics)


def test_options_that_cannot_be():
    with pytest.raises(ValueError, match="replay_size is 100, less than the 1024 steps of one iteration"):
        SACConfig(replay_size=100)
    assert SACConfig(num_envs=3, horizon=4, replay_size=100).capacity == 32  # whole iterations


def test_a_buffer_of_many_gigabytes_is_announced():
    large = sac.make_sac(ENV, dataclasses.replace(CONFIG, replay_size=10**9))
    with pytest.warns(UserWarning, match=r"^the replay buffer takes \d+ GB: a replay_size of \d+ takes 8 GB$"):
        jax.eval_shape(large.init, jax.random.key(0))
