"""Runs from their directories: the same policy, and sentences where there is none to build."""

import dataclasses
import functools
import io
import json
import shutil

import jax
import numpy as np
import pytest
import toys
from rich.console import Console

from rewax.agents.apg import APGConfig, make_apg
from rewax.agents.sapo import SAPOConfig, make_sapo
from rewax.envs import registry
from rewax.envs.randomize import Uniform, hook
from rewax.envs.randomized import Randomized
from rewax.training.config import TrainConfig
from rewax.training.loop.start import first_state
from rewax.training.loop.train import train
from rewax.training.storage import checkpoint
from rewax.training.storage.description import write_config
from rewax.training.storage.saved import load_run

CONFIG = SAPOConfig(
    num_envs=2, horizon=3, num_iterations=2, critic_passes=1, critic_minibatches=1, actor_widths=(4, 4), critic_widths=(4,), vector_features=4,
)  # fmt: skip
SMALLEST = APGConfig(num_envs=2, horizon=3, num_iterations=2, actor_widths=(4,), vector_features=4)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short run, its environment registered, and what training returned."""
    run_dir = tmp_path_factory.mktemp("run")
    registry._FACTORIES["PointMass"] = lambda scale: toys.point_mass(5 if scale == "small" else 7)
    env = registry.make("PointMass", scale="paper")
    quick = {"num_eval_episodes": 2, "plots": False, "baselines": False, "tensorboard": False}
    config = TrainConfig(num_iterations=2, run_dir=str(run_dir), checkpoint_every=1, **quick)
    describe = {"env": "PointMass", "scale": "paper", "agent": "sapo", "sapo": CONFIG}
    yield run_dir, train(make_sapo(env, CONFIG), env, config, describe=describe).train_state
    del registry._FACTORIES["PointMass"]


def test_the_policy_is_the_one_that_was_trained(run):
    run_dir, train_state = run
    saved = load_run(run_dir)
    assert saved.env.episode_length == 7 and saved.config["sapo"]["horizon"] == 3
    obs, key = saved.env.reset(jax.random.key(1)).obs, jax.random.key(2)
    act = jax.jit(saved.agent.policy, static_argnames="deterministic")
    for deterministic in (True, False):
        actions = [act(state, obs, key, deterministic=deterministic) for state in (saved.train_state, train_state)]
        np.testing.assert_array_equal(*actions)
    assert [int(load_run(run_dir, step=step).train_state.iteration) for step in (1, 2)] == [1, 2]


def test_what_cannot_be_built_is_said(run, tmp_path):
    run_dir, _ = run
    with pytest.raises(ValueError, match="nowhere holds no complete checkpoint: check the path"):
        load_run(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="no checkpoint of iteration 5"):
        load_run(run_dir, step=5)
    for step in (1.5, "1", True):
        with pytest.raises(ValueError, match=f"^step is {step!r}: give the iteration of a checkpoint, or None for the"):
            load_run(run_dir, step=step)
    with pytest.raises(ValueError, match=r"^env is 'PointMass': give an environment"):
        load_run(run_dir, env="PointMass")
    kept = (run_dir / "config.json").read_text()
    try:
        write_config(run_dir, {**json.loads(kept), "sapo": {"horizon": 3, "patience": 2}})
        with pytest.raises(
            ValueError,
            match=r"config\.json: sapo\.patience is unknown: .*or use the version that the run was made with",
        ):
            load_run(run_dir)
        write_config(run_dir, {"train": {}})
        with pytest.raises(ValueError, match="names no algorithm and its options: build the agent"):
            load_run(run_dir)
        write_config(run_dir, {**json.loads(kept), "agent": "mine", "mine": {}})
        with pytest.raises(
            ValueError, match=r"was trained with 'mine', which is not registered here: .*--import my_module"
        ):
            load_run(run_dir)
    finally:
        (run_dir / "config.json").write_text(kept)


OBS = {"x": np.zeros(1, np.float32)}


@pytest.mark.parametrize(
    ("obs", "given", "sentence"),
    [
        ({}, {}, "the observation has no array 'x', only nothing: give x"),
        ({"y": 0.0}, {}, "the observation has no array 'x', only y: give x"),
        (np.zeros(1), {}, "the observation is an array of float64 of shape (1,): give a dict of arrays by name, x,"),
        ([0.0], {}, "the observation is a list: give a dict of arrays by name, x, as state.obs"),
        (
            {"x": "abc"},
            {},
            "'x' of the observation is 'abc', which is no array of real numbers: give an array of shape",
        ),
        ({"x": np.zeros(2)}, {}, "'x' of the observation has shape (2,): give shape (1,), and jax.vmap for a batch"),
        ({"x": np.zeros((3, 1))}, {}, "'x' of the observation has shape (3, 1): give shape (1,), and jax.vmap for a"),
        (OBS, {"key": 3}, "the key is 3: give a random key"),
        (OBS, {"memory": np.zeros(2)}, "memory is given, but this policy has none: leave it out"),
    ],
)
def test_act_takes_the_observation_of_one_environment(run, obs, given, sentence):
    with pytest.raises(ValueError) as caught:
        load_run(run[0]).act(obs, **given)
    assert str(caught.value).startswith(sentence)


def test_act_takes_further_names_lists_and_batches(run):
    saved = load_run(run[0])
    expected = saved.act(OBS)
    for obs in ({**OBS, "more": np.ones(7)}, {"x": [0.0]}):
        np.testing.assert_array_equal(saved.act(obs), expected)
    batch = jax.vmap(saved.act)({"x": np.zeros((3, 1), np.float32)}, jax.random.split(jax.random.key(0), 3))
    assert batch.shape == (3, *expected.shape)


def load_again(tmp_path, env):
    """Train from code, without a word about agent or environment; returns the run directory and the training state."""
    quick = {"eval_every": 0, "num_eval_episodes": 2, "plots": False, "baselines": False, "tensorboard": False}
    config = TrainConfig(num_iterations=1, run_dir=str(tmp_path / "run"), **quick)
    return tmp_path / "run", train(make_sapo(env, CONFIG), env, config).train_state


@pytest.mark.parametrize(
    ("entry", "value", "sentence"),
    [
        (
            ("sapo", "num_env"),
            3,
            "config.json: sapo.num_env is unknown: did you mean 'num_envs'? this version has no such",
        ),
        (("sapo", "adam_b1"), -3, "config.json: sapo.adam_b1 is -3: give a number of at least 0 and below 1"),
        (("sapo", "learn_temperature"), "yes", "config.json: sapo.learn_temperature is 'yes': give True or False"),
        (("scale",), 3, "config.json: scale is 3: use one of 'paper', 'small'"),
        (("env_kwargs",), [1], "config.json: env_kwargs is [1]: give the arguments of rewax.make by name, or {}"),
        (("env_kwargs",), {"gain": 1}, "cannot be built: PointMass has no option 'gain'"),
    ],
)
def test_an_edited_configuration_is_refused_with_file_and_key(run, tmp_path, entry, value, sentence):
    run_dir = shutil.copytree(run[0], tmp_path / "run")
    config = json.loads((run_dir / "config.json").read_text())
    place = config
    for name in entry[:-1]:
        place = place[name]
    place[entry[-1]] = value
    (run_dir / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError) as caught:
        load_run(run_dir)
    assert sentence in str(caught.value) and "\n" not in str(caught.value)


def test_a_run_from_code_is_loaded_with_its_environment(run, tmp_path):
    env = toys.point_mass(7)
    run_dir, train_state = load_again(tmp_path, env)
    with pytest.raises(ValueError, match=r"names no environment, .* give it, load_run\(run_dir, env=env\)"):
        load_run(run_dir)
    saved = load_run(run_dir, env=env)
    assert saved.agent.config == CONFIG
    obs, act = env.reset(jax.random.key(1)).obs, jax.jit(functools.partial(saved.agent.policy, deterministic=True))
    np.testing.assert_array_equal(*[act(state, obs, jax.random.key(2)) for state in (saved.train_state, train_state)])


def test_a_run_from_code_is_loaded_by_the_name_of_its_environment(run, tmp_path):
    registry._FACTORIES["PointMass"], usual = (
        lambda scale, length=5: toys.point_mass(length),
        registry._FACTORIES["PointMass"],
    )
    try:
        env = registry.make("PointMass", scale="small", length=7)
        object.__setattr__(env, "made_by", {"env": "PointMass", "scale": "small", "kwargs": {"length": 7}})
        run_dir, _ = load_again(tmp_path, env)
        saved = load_run(run_dir)
        assert saved.env.episode_length == 7 and saved.config["agent"] == "sapo"
    finally:
        registry._FACTORIES["PointMass"] = usual


def test_a_damaged_checkpoint_is_passed_over_with_a_warning(run, tmp_path):
    run_dir = shutil.copytree(run[0], tmp_path / "run")
    (run_dir / "checkpoints" / "2" / "leaves.json").write_text("{")
    (run_dir / "checkpoints" / ".DS_Store").write_text("x")
    with pytest.warns(UserWarning, match="checkpoints/2 is damaged .* using the one of iteration 1 before it"):
        assert int(load_run(run_dir).train_state.iteration) == 1
    (run_dir / "config.json").write_text("null")
    with pytest.raises(ValueError, match=r"config\.json holds null, not named entries"):
        load_run(run_dir)


def test_a_run_with_another_simulation_state_begins_new_episodes(run, tmp_path):
    """That of an earlier version: its policy acts, and training goes on with all that was learnt."""
    run_dir, train_state = run
    other = shutil.copytree(run_dir, tmp_path / "run")
    old = train_state.environments.state.replace(physics={"height": np.zeros(2)})
    environments = train_state.environments.replace(state=old)
    checkpoint.save(other, train_state.replace(environments=environments, iteration=train_state.iteration + 1))
    with pytest.warns(UserWarning, match="checkpoints/3 had another state, .* is kept, and new episodes begin"):
        saved = load_run(other)
    begun = saved.train_state
    np.testing.assert_array_equal(begun.environments.state.step_count, 0)
    assert jax.tree.structure(begun) == jax.tree.structure(train_state)
    kept = [(state.actor_params, state.actor_opt, state.environments.env) for state in (begun, train_state)]
    jax.tree.map(np.testing.assert_array_equal, *kept)
    assert int(saved.agent.train_step(begun)[0].iteration) == 4
    with pytest.raises(checkpoint.OtherStructure, match=r"\.environments\.state\.physics"):
        checkpoint.restore(other, train_state)
    console = Console(file=io.StringIO(), width=500)
    resumed = (
        saved.agent,
        saved.env,
        TrainConfig(num_iterations=4, run_dir=str(other), resume=True),
        other,
        jax.random.key(0),
    )
    longer = {**saved.config, "sapo": {**saved.config["sapo"], "num_iterations": 4}}
    assert int(first_state(*resumed, longer, console).iteration) == 3
    for note in ("checkpoints/3 had another state", "note: resuming with sapo.num_iterations 4, it was 2"):
        assert note in console.file.getvalue()
    wider = environments.replace(episode_return=np.zeros(3))
    checkpoint.save(other, train_state.replace(environments=wider, iteration=train_state.iteration + 2))
    with pytest.raises(checkpoint.OtherStructure, match="episode_return"):
        load_run(other)


def test_a_run_whose_agent_drew_parameters_is_loaded_with_its_draws(run, tmp_path):
    draws = hook({"gain": Uniform(0.4, 0.6)})
    env = registry.make("PointMass", scale="paper")
    quick = {"num_eval_episodes": 2, "plots": False, "baselines": False, "tensorboard": False}
    config = TrainConfig(num_iterations=1, run_dir=str(tmp_path), eval_every=0, **quick)
    train(make_apg(env, SMALLEST, randomize=draws), env, config)
    with pytest.raises(ValueError, match=r"load_run\(run_dir, env=Randomized\(env=env, randomize=\.\.\.\)\)$"):
        load_run(tmp_path)
    saved = load_run(tmp_path, env=Randomized(env=env, randomize=draws))
    assert saved.env.reset(jax.random.key(0)).drawn[".gain"] != 0.5
    other = env.replace(gain=0.7)
    console = Console(file=io.StringIO(), width=300)
    agent = make_apg(other, SMALLEST, randomize=draws)
    train(agent, other, dataclasses.replace(config, resume=True, num_iterations=2), console=console)
    assert "note: the environment given has other values of gain: the run keeps its own" in console.file.getvalue()
