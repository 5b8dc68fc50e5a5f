"""Environments of a run: equal, different or randomised parameters, which are data of the compiled program."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax.agents.gradients import per_env_gradients
from rewax.agents.rollout import rollout
from rewax.agents.run_state import RunState, partition, run_keys, start_environments
from rewax.agents.sapo import SAPOConfig, make_sapo
from rewax.envs.leaves import EnvLeaves, stack
from rewax.envs.randomize import Scale, Uniform, hook
from rewax.envs.wrappers import AutoReset

NUM, LENGTH = 3, 5
CONFIG = SAPOConfig(
    num_envs=NUM,
    horizon=4,
    critic_passes=1,
    critic_minibatches=1,
    actor_widths=(8,),
    critic_widths=(8,),
    vector_features=8,
    differentiate="full",
)
ENVS = [toys.point_mass().replace(gain=jnp.float32(g)) for g in (0.1, 0.5, 1.0)]


def start(env, randomize=None, **changes):
    config = dataclasses.replace(CONFIG, **changes)
    return start_environments(config, partition(env, NUM, randomize), run_keys(jax.random.key(0)))


def double():
    return hook({"gain": Scale(Uniform(0.5, 2.0))})


def test_a_batch_is_each_environment_alone():
    def loss(params, common, env, state, key):
        assert common.environments.state is None  # each has its own
        _, t = rollout(env, state, lambda obs, k: (params, {}), key, horizon=4, differentiate="full")
        return -t.reward.sum(), t

    params, key = jnp.array([0.3]), jax.random.key(1)

    @jax.jit
    def gradients(environments):
        state = RunState(environments=environments, key=key)
        return per_env_gradients(loss, params, state.common(), state.environments, key)

    losses, data, grads = gradients(start(stack(ENVS)))
    for i, env in enumerate(ENVS):
        one = gradients(start(env))
        np.testing.assert_allclose(losses[i], one[0][i], rtol=1e-6)
        np.testing.assert_allclose(grads[i], one[2][i], rtol=1e-5)
        np.testing.assert_allclose(data.obs["x"][i], one[1].obs["x"][i], rtol=1e-6)
    assert abs(grads[0] - grads[2]).min() > 1e-3


@pytest.mark.parametrize(
    "kind", ["one", *(pytest.param(k, marks=pytest.mark.slow) for k in ("batch", "randomized", "randomized batch"))]
)
def test_the_second_step_with_other_parameters_compiles_nothing(kind):
    env = stack(ENVS) if "batch" in kind else ENVS[1]
    agent = make_sapo(env, CONFIG, randomize=double() if "randomized" in kind else None)
    state = agent.init(jax.random.key(0))
    before = agent.train_step._cache_size()
    first, _ = agent.train_step(state)
    envs = state.environments
    arrays = {name: 0.5 * a for name, a in envs.env.arrays.items()}
    assert arrays, "the parameters are part of the training state"
    other, _ = agent.train_step(state.replace(environments=envs.replace(env=envs.env.replace(arrays=arrays))))
    assert agent.train_step._cache_size() == before + 1
    x = [np.asarray(s.environments.state.physics) for s in (first, other)]
    if "randomized" not in kind:  # there the drawn parameters act until the next reset
        assert (x[0] != x[1]).all()


def test_agents_of_other_parameters_share_their_program():
    one, two = (make_sapo(env, CONFIG) for env in ENVS[:2])
    assert one.train_step is two.train_step
    one.train_step(one.init(jax.random.key(0)))
    size = one.train_step._cache_size()
    state, _ = two.train_step(two.init(jax.random.key(0)))
    assert two.train_step._cache_size() == size
    assert state.environments.env.arrays[".gain"] == 0.5
    third = make_sapo(ENVS[0], dataclasses.replace(CONFIG, discount=0.9))
    assert third.train_step is not one.train_step


def test_parameters_are_arguments_of_the_program_not_constants():
    agent = make_sapo(ENVS[0].replace(gain=jnp.float32(0.123457)), CONFIG)
    text = agent.train_step.lower(jax.eval_shape(agent.init, jax.random.key(0))).as_text()
    assert "0.123457" not in text


def test_each_episode_draws_parameters_of_its_own():
    agent = make_sapo(ENVS[1], CONFIG, randomize=double())
    assert agent.train_step is make_sapo(ENVS[1], CONFIG, randomize=double()).train_step
    state = agent.init(jax.random.key(0))
    drawn = [np.asarray(state.environments.state.drawn[".gain"])]
    for _ in range(3):  # twelve steps, episodes of five
        state, _ = agent.train_step(state)
        drawn.append(np.asarray(state.environments.state.drawn[".gain"]))
    assert len({*np.concatenate(drawn)}) == 3 * 3
    assert np.min(drawn) >= 0.25 and np.max(drawn) <= 1.0
    assert state.environments.env.arrays[".env.gain"] == 0.5


def test_a_batch_of_another_size_is_refused_before_anything_compiles():
    with pytest.raises(ValueError, match=r"^num_envs is 3, but .gain of the batch has shape \(2,\): give every"):
        make_sapo(stack(ENVS[:2]), CONFIG)


@pytest.mark.parametrize("env", [None, "RollingFlat", toys.PointMass])
def test_what_is_no_environment_is_refused(env):
    with pytest.raises(ValueError, match=r"^env is .*: give an environment, rewax.make\('RollingFlat'\) for example$"):
        make_sapo(env, CONFIG)


def test_an_environment_that_resets_by_itself_is_refused():
    """Its observation after an episode's end is that of the next one, and values would bootstrap from it."""
    env = AutoReset(env=ENVS[0])
    sentence = "^env has an AutoReset, but agents reset by themselves: give the environment without AutoReset$"
    for given in (env, stack([env] * 3)):
        with pytest.raises(ValueError, match=sentence):
            make_sapo(given, CONFIG)


def test_a_hook_that_the_environment_refuses_is_refused_before_anything_compiles():
    sentence = (
        r"^PointMass has no parameter 'gian': near are gain; rewax.envs.randomize.leaves\(env\) has all 1 by name"
    )
    for env in (ENVS[0], stack(ENVS)):
        with pytest.raises(ValueError, match=sentence):
            make_sapo(env, CONFIG, randomize=hook({"gian": Uniform(0.5, 2.0)}))


def test_environments_start_apart_if_asked_to():
    counts = np.asarray(start(ENVS[0], stagger_episodes=True).state.step_count)
    assert (counts < LENGTH).all() and len(set(counts)) > 1
    np.testing.assert_array_equal(start(ENVS[0]).state.step_count, np.zeros(NUM))


def test_new_episodes_begin_apart_if_the_run_does():
    environments = start(ENVS[0])
    state = RunState(environments=environments.replace(episode_return=jnp.full(NUM, 7.0)), key=jax.random.key(1))
    together = state.restarted(CONFIG).environments
    np.testing.assert_array_equal([together.state.step_count, together.episode_return], 0)
    apart = state.restarted(dataclasses.replace(CONFIG, stagger_episodes=True)).environments
    counts = np.asarray(apart.state.step_count)
    assert len(set(counts)) > 1 and counts.min() >= 0 and counts.max() < LENGTH
    np.testing.assert_array_equal(np.isnan(apart.episode_return), counts > 0)
    state.restarted(None)  # an agent without options


def test_seeds_side_by_side_are_each_seed_alone():
    agent = make_sapo(ENVS[1], CONFIG)
    keys = jax.random.split(jax.random.key(7), 2)
    many, _ = jax.jit(jax.vmap(lambda key: agent.train_step(agent.init(key))))(keys)
    one, _ = agent.train_step(agent.init(keys[1]))
    for a, b in zip(jax.tree.leaves(many.actor_params), jax.tree.leaves(one.actor_params), strict=True):
        np.testing.assert_allclose(a[1], b, rtol=1e-4, atol=1e-6)


def test_the_training_state_restores_an_environments_parameters():
    leaves = EnvLeaves.of(ENVS[2])
    state = make_sapo(ENVS[0], CONFIG).init(jax.random.key(0))
    moved = state.replace(environments=state.environments.replace(env=leaves))
    assert moved.environments.env.build().gain == 1.0
