"""Policies for other libraries: the actions of the run, one observation or many at a time."""

import dataclasses

import jax
import memory_toys
import numpy as np
import pytest
import toys

from rewax.adapters.policy import numpy_policy
from rewax.agents.sapo import SAPOConfig, make_sapo
from rewax.training.storage.saved import SavedRun


@pytest.fixture(scope="module")
def run():
    env = toys.point_mass(4)
    config = SAPOConfig(num_envs=2, horizon=2, actor_widths=(4,), critic_widths=(4,), vector_features=4)
    agent = make_sapo(env, config)
    return SavedRun(env, agent, agent.init(jax.random.key(0)), {})


def test_the_actions_are_the_runs_one_by_one_and_in_a_batch(run):
    obs = run.env.reset(jax.random.key(3)).obs
    act, expected = numpy_policy(run), np.asarray(run.act(obs))
    np.testing.assert_allclose(act(obs), expected, rtol=1e-6)
    batch = {name: np.stack([value, value + 1.0]) for name, value in obs.items()}
    both = act(batch)
    assert both.shape == (2, *expected.shape)
    np.testing.assert_allclose(both[0], expected, rtol=1e-6)
    assert not np.allclose(both[0], both[1])


def test_drawn_actions_follow_the_seed(run):
    obs = run.env.reset(jax.random.key(3)).obs
    draws = [numpy_policy(run, deterministic=False, seed=seed) for seed in (1, 1, 2)]
    first, same, other = (np.array([act(obs), act(obs)]) for act in draws)
    np.testing.assert_array_equal(first, same)
    assert not np.allclose(first, other) and not np.allclose(first[0], first[1])


def test_a_memory_goes_from_call_to_call_and_begins_anew_where_an_episode_ended(run):
    agent = make_sapo(run.env, dataclasses.replace(run.agent.config, memory=3))
    remembering = SavedRun(run.env, agent, agent.init(jax.random.key(0)), {})
    act, steps = numpy_policy(remembering), np.linspace(-1.0, 1.0, 8, dtype=np.float32).reshape(4, 2, 1)
    ended = [np.array(pair) for pair in ([False, False], [False, True], [False, False])]
    found = [act({"x": steps[0]}), *(act({"x": x}, done) for x, done in zip(steps[1:], ended, strict=True))]
    for i in range(2):
        memory = None
        for t, x in enumerate(steps[:, i]):
            if t and ended[t - 1][i]:
                memory = None
            action, memory = remembering.act({"x": x}, memory=memory)
            np.testing.assert_allclose(found[t][i], action, rtol=1e-5, atol=1e-6)
    act.reset()
    np.testing.assert_array_equal(act({"x": steps[0]}), found[0])
    assert not np.allclose(act({"x": steps[0]}), found[0])


def test_another_observation_is_refused(run):
    with pytest.raises(ValueError, match=r"this policy needs \{'x'"):
        numpy_policy(run)({"y": np.zeros(1)})


def test_in_dm_env_it_earns_what_it_earns_at_home(run):
    dm = pytest.importorskip("dm_env", reason="pip install 'rewax[dm-env]'")
    from rewax.adapters.dm_env import DmEnvironment

    env, act = DmEnvironment(run.env, seed=5), numpy_policy(run)
    timestep, total = env.reset(), 0.0
    start = env._state
    while timestep.step_type != dm.StepType.LAST:
        timestep = env.step(act(timestep.observation))
        total += timestep.reward
    state, expected = start, 0.0
    while not bool(state.done):
        state = run.env.step(state, run.act(state.obs))
        expected += float(state.reward)
    np.testing.assert_allclose(total, expected, rtol=1e-5)


def test_only_what_the_policy_observes_is_needed():
    env = memory_toys.shown_once()
    agent = memory_toys.agent("shac", env, memory=0, observe=("x",))
    asymmetric = SavedRun(env, agent, agent.init(jax.random.key(0)), {})
    obs = env.reset(jax.random.key(1)).obs
    np.testing.assert_allclose(numpy_policy(asymmetric)({"x": obs["x"]}), asymmetric.act(obs), rtol=1e-6)


def test_a_memory_of_another_batch_is_refused():
    env, agent = memory_toys.shown_once(), memory_toys.agent("shac")
    act = numpy_policy(SavedRun(env, agent, agent.init(jax.random.key(0)), {}))
    one = {name: np.asarray(value) for name, value in env.reset(jax.random.key(1)).obs.items()}
    act(one)
    with pytest.raises(ValueError, match=r"has the batch \(2,\), but the memory that of \(\): call reset\(\)"):
        act({name: np.stack([value, value]) for name, value in one.items()})
