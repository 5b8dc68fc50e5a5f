"""FlashSAC: its critics' probabilities, its bounds, the noise that is held, and how often the actor is updated."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_cases import CASES, ENV, agent

from rewax.agents import flash_sac
from rewax.agents.actor_critic import make_actor_critic
from rewax.agents.flash_sac import FlashSACConfig, held_noise, projected, smallest
from rewax.agents.replay import Sample

CONFIG = CASES["flash_sac"].config
NETWORKS = make_actor_critic(ENV, CONFIG, num_outputs=CONFIG.num_values)
VALUES = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])


@pytest.fixture(scope="module")
def start():
    return agent("flash_sac").init(jax.random.key(0))


@pytest.fixture(scope="module")
def after_one():
    without_warm_up = flash_sac.make_flash_sac(ENV, dataclasses.replace(CONFIG, warmup_steps=0))
    return without_warm_up.train_step(agent("flash_sac").init(jax.random.key(0)))[0]


def project(probabilities, moved):
    return np.asarray(jax.jit(projected)(jnp.asarray(probabilities), jnp.asarray(moved), jnp.asarray(VALUES)))


def test_projected_probabilities_keep_their_sum_and_their_mean():
    probabilities = np.array([[0.15, 0.2, 0.3, 0.1, 0.25]])
    moved = 0.3 + 0.6 * VALUES[None]
    new = project(probabilities, moved)
    np.testing.assert_allclose(new.sum(), 1.0, rtol=1e-6)
    np.testing.assert_allclose(new @ VALUES, np.sum(probabilities * moved, axis=1), rtol=1e-5)
    assert new[0, 0] == 0.0  # the smallest of the moved values is -0.9


def test_each_probability_goes_to_the_two_nearest_values_and_to_the_last_one_beyond():
    one = np.array([[0.0, 0.0, 1.0, 0.0, 0.0]])
    np.testing.assert_allclose(project(one, np.full((1, 5), 0.25)), [[0.0, 0.0, 0.75, 0.25, 0.0]])
    np.testing.assert_allclose(project(one, np.full((1, 5), -1.0)), [[0.0, 1.0, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(project(one, np.full((1, 5), 9.0)), [[0.0, 0.0, 0.0, 0.0, 1.0]])


def test_the_target_is_that_of_the_critic_with_the_smaller_mean():
    probabilities = np.array([[[0, 0, 0, 0, 1.0], [0, 0, 0.5, 0.5, 0]], [[1.0, 0, 0, 0, 0], [0, 0, 1.0, 0, 0]]])
    np.testing.assert_array_equal(smallest(probabilities, VALUES), [probabilities[0, 1], probabilities[1, 0]])


def test_critics_learn_the_probabilities_of_the_soft_target(start):
    """The loss of two samples, one of them at the end of an episode, written out for one sample."""
    keys = jax.random.split(jax.random.key(2), 4)
    data = Sample(
        obs={"x": jax.random.normal(keys[0], (3, 1))},
        action=jnp.tanh(jax.random.normal(keys[1], (3, 1))),
        reward=jax.random.normal(keys[2], (3,)),
        discount=jnp.array([0.9, 0.0, 0.5]),
        next_obs={"x": jax.random.normal(keys[3], (3, 1))},
        valid=jnp.array([True, True, False]),
    )
    key = jax.random.key(4)
    loss, metrics = jax.jit(
        lambda params: flash_sac.critic_loss(params, networks=NETWORKS, state=start, batch=data, key=key)
    )(start.critic_params)
    values = np.asarray(CONFIG.values, np.float64)
    gap = values[1] - values[0]

    @jax.jit
    @jax.vmap
    def parts(one, key):
        action, log_prob = NETWORKS.distribution(start.actor_params, one.next_obs).sample_and_log_prob(key)
        following = jax.nn.softmax(NETWORKS.critics.apply(start.target_params, one.next_obs, action))
        return log_prob, following, NETWORKS.critics.apply(start.critic_params, one.obs, one.action)

    losses = []
    of_samples = jax.device_get(parts(data, jax.random.split(key, 3)))
    for i, (log_prob, following, logits) in enumerate(zip(*of_samples, strict=True)):
        target = np.zeros(len(values))
        least = following[np.argmin(following @ values)]
        for value, probability in zip(values, least, strict=True):
            moved = data.reward[i] + data.discount[i] * (value - CONFIG.initial_temperature * log_prob)
            place = (np.clip(moved, values[0], values[-1]) - values[0]) / gap
            below = min(int(place), len(values) - 2)
            target[below] += probability * (below + 1 - place)
            target[below + 1] += probability * (place - below)
        log_probabilities = logits - np.log(np.sum(np.exp(logits), axis=1, keepdims=True))
        losses.append(np.mean(-log_probabilities @ target))
    np.testing.assert_allclose(loss, np.mean(losses[:2]), rtol=1e-4)
    assert abs(float(metrics["value"])) < CONFIG.value_limit


def test_weights_have_norm_1_from_the_start_and_after_updates(start, after_one):
    for state in (start, after_one):
        for params in (state.actor_params, state.critic_params):
            flat = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(params)}
            for name, leaf in flat.items():
                if "kernel" in name:
                    np.testing.assert_allclose(np.linalg.norm(leaf, axis=0), 1.0, rtol=1e-5, err_msg=name)
                if "scale" in name:
                    both = np.concatenate([leaf, flat[name.replace("scale", "bias")]])
                    np.testing.assert_allclose(np.linalg.norm(both), np.sqrt(leaf.size), rtol=1e-5, err_msg=name)
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), start.actor_params, after_one.actor_params)
    assert any(jax.tree.leaves(moved))


def test_the_actor_is_updated_once_in_two_updates_of_the_critics(after_one):
    def count(optimizer_state):
        return max(int(leaf) for leaf in jax.tree.leaves(optimizer_state) if leaf.dtype == jnp.int32)

    assert CONFIG.actor_period == 2
    counts = [count(opt) for opt in (after_one.critic_opt, after_one.actor_opt, after_one.temperature_opt)]
    assert counts == [CONFIG.updates, CONFIG.updates // 2, CONFIG.updates // 2]


def test_noise_is_held_for_numbers_of_steps_that_fall_with_their_square():
    noise = np.asarray(jax.jit(held_noise, static_argnums=(1, 2, 3))(jax.random.key(0), 20_000, 2, 16))
    begins = np.flatnonzero(np.r_[True, (noise[1:] != noise[:-1]).any(axis=1)])
    lengths = np.diff(begins)
    wanted = 1.0 / np.arange(1, 17) ** 2
    shares = np.bincount(lengths, minlength=17)[1:] / len(lengths)
    assert lengths.max() <= 16
    np.testing.assert_allclose(shares, wanted / wanted.sum(), atol=0.01)
    np.testing.assert_allclose(noise[begins].std(axis=0), 1.0, atol=0.03)
    every = np.asarray(held_noise(jax.random.key(0), 50, 1, 1))
    assert len(np.unique(every)) == 50


def test_updates_that_are_no_multiple_of_the_actors_period_are_refused():
    with pytest.raises(ValueError, match="updates is 7, no multiple of actor_period = 2: give a multiple"):
        FlashSACConfig(updates=7)
    assert dataclasses.replace(CONFIG, updates=7, actor_period=1).updates == 7
