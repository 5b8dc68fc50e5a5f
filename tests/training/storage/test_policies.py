"""Policies that the package brings: all of them load and act, and what does not fit is a sentence."""

import dataclasses
import json

import jax
import numpy as np
import pytest
import toys

from rewax.agents.sapo import SAPOConfig, make_sapo
from rewax.agents.trajopt import TrajOptConfig, make_trajopt
from rewax.cli.main import main
from rewax.envs import registry
from rewax.training.evaluation.episodes import make_evaluate
from rewax.training.evaluation.programs import MODES, any_of
from rewax.training.storage import policies
from rewax.training.storage.policies import list_policies, load_policy, open_run, read_card, save_policy
from rewax.training.storage.saved import SavedRun
from rewax.training.suites.suite import read_suite

CONFIG = SAPOConfig(num_envs=2, horizon=2, actor_widths=(4,), critic_widths=(4,), vector_features=4)
SHIPPED = list_policies()
QUICK = [("AntRun", "small"), ("FoldCloth", "small"), ("RollingFlat", "small")]
"""Of a robot, of cloth, and of particles. The others' networks are of the same kinds."""


@pytest.fixture
def toy(monkeypatch):
    """A task under a name, and a run of it."""
    monkeypatch.setitem(registry._FACTORIES, "ToyToShip", lambda scale: toys.point_mass(4))
    env = registry.make("ToyToShip", scale="small")
    agent = make_sapo(env, CONFIG)
    config = {"env": "ToyToShip", "scale": "small", "agent": "sapo", "sapo": CONFIG}
    return SavedRun(env, agent, agent.init(jax.random.key(0)), config)


@pytest.fixture
def shipped(toy, tmp_path, monkeypatch):
    """The toy's policy where the package keeps its own."""
    save_policy(toy, tmp_path, {"command": "rewax train --env ToyToShip", "seed": 0})
    monkeypatch.setattr(policies, "FOLDER", tmp_path)
    return toy


def test_each_task_of_the_small_suite_has_a_policy():
    assert set(read_suite("small").tasks) <= {name for name, scale in SHIPPED if scale == "small"}


@pytest.mark.parametrize(("name", "scale"), SHIPPED)
def test_a_shipped_policy_fits_its_task_and_its_card_says_what_it_earns(name, scale):
    run, card = load_policy(name, scale=scale), read_card(name, scale=scale)
    obs = {what: np.zeros(spec.shape, np.float32) for what, spec in run.env.observation_spec.items()}
    assert jax.eval_shape(run.act, obs).shape == run.env.action_spec.shape
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(run.train_state.actor_params))
    best = max(card["returns"][mode]["mean"] for mode in MODES[2:])
    assert card["returns"]["deterministic"]["low"] > best
    assert card["command"].startswith(f"rewax train --env {name} --scale {scale}")
    assert {"commit", "processor", "jax"} <= set(card["trained"]) and card["seed"] is not None
    assert int(run.train_state.iteration) == card["iteration"] and not jax.tree.leaves(
        run.train_state.environments.state
    )


@pytest.mark.parametrize(
    ("name", "scale"), [case if case in QUICK else pytest.param(*case, marks=pytest.mark.slow) for case in SHIPPED]
)
def test_a_shipped_policy_acts_within_bounds_and_the_same_each_time(name, scale):
    run = load_policy(name, scale=scale)
    generator = np.random.default_rng(0)
    obs = {
        what: generator.normal(size=spec.shape).astype(np.float32) for what, spec in run.env.observation_spec.items()
    }
    action, again = run.act(obs), run.act(obs)
    assert action.shape == run.env.action_spec.shape and np.all(np.abs(action) <= 1.0)
    np.testing.assert_array_equal(action, again)
    if name in ("RollingFlat", "AntRun"):  # a program of its own, the same for all
        drawn = run.act(obs, jax.random.key(1))
        assert np.all(np.isfinite(drawn)) and not np.array_equal(action, drawn)


def test_a_shipped_policy_earns_what_its_card_says():
    run = load_policy("CartpoleSwingUp", scale="small")
    evaluate = make_evaluate(run.env, any_of(run.env, run.agent.policy), 8)
    trained, random = (float(evaluate((run.train_state, mode), jax.random.key(7))["mean"]) for mode in (1, 3))
    said = run.config["returns"]["deterministic"]
    assert abs(trained - said["mean"]) < 4.0 * said["std"] / 8**0.5
    assert trained > random + 1000.0


def test_a_policy_acts_as_the_run_did_and_keeps_nothing_else(toy, shipped):
    loaded = load_policy("ToyToShip")
    obs, key = toy.env.reset(jax.random.key(1)).obs, jax.random.key(2)
    for drawn in (None, key):
        np.testing.assert_array_equal(loaded.act(obs, drawn), toy.act(obs, drawn))
    assert jax.tree.leaves(loaded.train_state.actor_params) and not jax.tree.leaves(loaded.train_state.critic_params)
    with np.load(policies.FOLDER / "ToyToShip-small.npz") as file:
        assert all("critic" not in name and "_opt" not in name for name in file.files)


def test_a_policy_with_memory_is_kept_and_loaded_too(toy, tmp_path):
    config = dataclasses.replace(CONFIG, memory=3)
    agent = make_sapo(toy.env, config)
    run = SavedRun(toy.env, agent, agent.init(jax.random.key(5)), {**toy.config, "sapo": config})
    save_policy(run, tmp_path, {})
    loaded, obs = load_policy("ToyToShip", folder=tmp_path), toy.env.reset(jax.random.key(1)).obs
    assert loaded.initial_memory.tolist() == [0.0, 0.0, 0.0]
    first = run.act(obs)
    for memory in (None, first.memory):
        jax.tree.map(np.testing.assert_array_equal, loaded.act(obs, memory=memory), run.act(obs, memory=memory))
    assert not np.array_equal(run.act(obs, memory=first.memory).action, first.action)
    with pytest.raises(ValueError, match=r"^memory has shape \(2,\): give shape \(3,\), what act returned"):
        run.act(obs, memory=np.zeros(2))


def test_a_task_that_has_changed_is_named_with_what_changed(shipped, monkeypatch):
    monkeypatch.setitem(registry._FACTORIES, "ToyToShip", lambda scale: toys.point_mass(9))
    with pytest.raises(ValueError, match=r"ToyToShip has changed.*steps of an episode was 4 and is 9.*train another"):
        load_policy("ToyToShip")


def test_a_damaged_file_is_refused(shipped):
    path = policies.FOLDER / "ToyToShip-small.npz"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(ValueError, match="missing or damaged: install rewax anew"):
        load_policy("ToyToShip")
    with pytest.raises(ValueError, match=r"\.npz is missing or damaged: write it anew with save_policy"):
        load_policy("ToyToShip", folder=policies.FOLDER)


@pytest.mark.parametrize(
    "damage",
    [
        lambda card: b"",
        lambda card: b"[]",
        lambda card: b"\xff\x00",
        lambda card: json.dumps({name: card[name] for name in card if name != "env"}).encode(),
        lambda card: json.dumps({name: card[name] for name in card if name != "sapo"}).encode(),
        lambda card: json.dumps({**card, "env_kwargs": 3}).encode(),
    ],
)
def test_a_damaged_card_is_refused(shipped, damage):
    path = policies.FOLDER / "ToyToShip-small.json"
    path.write_bytes(damage(json.loads(path.read_text())))
    for folder, remedy in ((None, "install rewax anew"), (policies.FOLDER, "write it anew with save_policy")):
        with pytest.raises(ValueError, match=rf"\.json is missing or damaged: {remedy}$"):
            load_policy("ToyToShip", folder=folder)


def test_a_name_is_no_environment_to_act_in(shipped):
    with pytest.raises(ValueError, match=r"^env is 'ToyToShip': give an environment"):
        load_policy("ToyToShip", env="ToyToShip")


def test_another_network_is_refused(shipped):
    path = policies.FOLDER / "ToyToShip-small.json"
    card = json.loads(path.read_text())
    path.write_text(json.dumps(card | {"sapo": {**card["sapo"], "actor_widths": [5]}}))
    with pytest.raises(ValueError, match="does not fit this sapo"):
        load_policy("ToyToShip")


def test_what_is_neither_a_run_nor_a_policy_is_one_sentence(shipped):
    with pytest.raises(ValueError, match=r"'ToyToShop' is neither.*did you mean 'ToyToShip'.*or one of ToyToShip"):
        open_run("ToyToShop")
    with pytest.raises(ValueError, match=r"no trained policy of Hopper yet: train one, rewax train --env Hopper"):
        open_run("Hopper")
    with pytest.raises(ValueError, match="another scale than small"):
        open_run("ToyToShip", scale="paper")
    with pytest.raises(ValueError, match="of one iteration: leave the step out"):
        open_run("ToyToShip", step=3)


def test_a_sequence_of_actions_is_no_policy(toy, tmp_path):
    agent = make_trajopt(toy.env, TrajOptConfig(num_envs=2))
    config = {"env": "ToyToShip", "scale": "small", "agent": "trajopt", "trajopt": agent.config}
    run = SavedRun(toy.env, agent, agent.init(jax.random.key(0)), config)
    with pytest.raises(ValueError, match="a sequence of actions"):
        save_policy(run, tmp_path, {})
    with pytest.raises(ValueError, match="sequence of actions: call"):
        run.act({})


def test_the_scale_of_a_run_is_its_own(tmp_path, monkeypatch):
    run = SavedRun(None, None, None, {"scale": "small"})
    monkeypatch.setattr(policies, "load_run", lambda where, step: run)
    assert open_run(tmp_path) is open_run(tmp_path, scale="small") is run
    with pytest.raises(ValueError, match=r"scale is 'paper', but .* is a run at scale 'small': leave the scale out"):
        open_run(tmp_path, scale="paper")


def test_play_eval_and_export_take_a_tasks_name(shipped, tmp_path, monkeypatch, capsys):
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    assert main(["play", "ToyToShip", "--frames=3"]) == 0
    assert "ToyToShip, iteration 0" in (here / "player.html").read_text()
    assert main(["eval", "ToyToShip", "--episodes=2", "--no-video"]) == 0
    assert "deterministic mean" in capsys.readouterr().out
    assert main(["export", "ToyToShip"]) == 0
    assert (here / "ToyToShip-policy" / "weights.npz").is_file()
    assert main(["eval", "ToyToShip", "--run-dir=elsewhere"]) == 2
