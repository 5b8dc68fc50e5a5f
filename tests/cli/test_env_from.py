"""``rewax train --env-from``: parameters that were identified, drawn or fixed, kept by ``--resume`` and ``load_run``."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import toys
from toys import QUICK_RUN as QUICK
from toys import ToyConfig
from toys import make_configured as make

import rewax
from rewax.agents import registry as agents
from rewax.agents.registry import Algorithm
from rewax.cli import env_from
from rewax.cli.env_from import env_and_scale, env_arguments, sentences
from rewax.cli.main import main as command
from rewax.envs import registry
from rewax.envs.randomize.stored import FORMAT
from rewax.training.storage.description import read_config
from rewax.training.storage.saved import load_run


def result(path, *, env="PointMass", kwargs=None, name="gain", value=0.3):
    """A file as ``rewax identify`` writes it, of one parameter with an uncertainty of 10 %."""
    posterior = {"kind": "LogNormal", "median": value, "log_std": 0.1, "low": 0.5 * value, "high": 2.0 * value}
    prior = {"kind": "LogUniform", "low": 0.5 * value, "high": 2.0 * value}
    unknown = {"names": [name], "change": "", "prior": prior, "posterior": posterior}
    made_by = {"env": env, "scale": "small", "kwargs": kwargs or {}}
    path.write_text(json.dumps({"format": FORMAT, "made_by": made_by, "values": {name: value}, "unknowns": [unknown]}))
    return str(path)


@pytest.fixture
def train(tmp_path, monkeypatch, capfd):
    """``train(*argv)``: exit code and output of ``rewax train`` with a toy algorithm, in an empty directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(registry._FACTORIES, "PointMass", lambda scale, length=5: toys.point_mass(length))
    monkeypatch.setitem(agents._ALGORITHMS, "toy", lambda: Algorithm(make, ToyConfig, lambda env, scale: ToyConfig()))

    def call(*argv):
        code = command(["train", "--algo=toy", "--run-dir=a", *argv, *QUICK])
        return code, "".join(capfd.readouterr())

    return call


def test_draws_of_the_posterior_reach_every_environment_and_a_resumed_run(train, tmp_path):
    path = result(tmp_path / "push.json", kwargs={"length": 7})
    code, text = train("--env-from", path, "--steps=12")
    assert code == 0 and "identified: gain 0.3 (drawn at every reset, log_std 0.1)" in text
    kwargs = read_config("a")["env_kwargs"]
    assert kwargs["length"] == 7 and kwargs["identified"]["use"] == "draws"
    (tmp_path / "push.json").unlink()  # the run has what it needs
    code, text = train("--env=PointMass", "--steps=24", "--resume")
    assert code == 0, text
    assert "a after iteration 1" in text, text.splitlines()[:12]
    assert "env_kwargs" not in text, text.splitlines()[:12]
    assert read_config("a")["env_kwargs"] == kwargs
    saved = load_run("a")
    gains = np.asarray(saved.train_state.envs.drawn[".gain"])
    assert len(set(gains.tolist())) == 4 and gains.min() > 0.15 and gains.max() < 0.6
    assert saved.env.episode_length == 7 and saved.env.unwrapped.gain == 0.5


def test_values_found_become_the_environment(train, tmp_path):
    path = result(tmp_path / "push.json")
    assert train("--env-from", path, "--env-from-values", "--env=PointMass", "--steps=12")[0] == 0
    assert load_run("a").env.gain == jnp.float32(0.3)
    code, text = train("--env-from", path, "--env=PointMass", "--steps=24", "--resume")  # draws instead
    assert code == 2 and "the run to be resumed has other parameters than" in text
    assert train("--env-from", path, "--env-from-values", "--env=PointMass", "--steps=24", "--resume")[0] == 0


def test_names_of_options_may_have_underscores(train, tmp_path):
    path = result(tmp_path / "push.json")
    assert train(f"--env_from={path}", "--env_from_values", "--run_dir", "b", "--steps=12")[0] == 0
    assert load_run("b").env.gain == jnp.float32(0.3)
    assert train("--env=PointMass", "--run_dir=b", "--steps=24", "--resume")[0] == 0


def test_seeds_side_by_side_and_directories_by_default_keep_their_parameters(train, tmp_path):
    path = result(tmp_path / "push.json")
    seeds = ["--env=PointMass", "--num-seeds=2", "--run-dir=b"]
    assert train("--env-from", path, *seeds, "--steps=12")[0] == 0
    assert train(*seeds, "--steps=24", "--resume")[0] == 0
    kwargs = read_config("b/1")["env_kwargs"]
    assert kwargs["identified"]["values"] == {"gain": 0.3}
    code, text = train("--env=PointMass", "--seed=1", "--run-dir=", "--steps=12")
    assert code == 0 and "toy on PointMass, seed 1" in text
    code, text = train("--env-from", path, "--seed=1", "--run-dir=", "--steps=24", "--resume")
    assert code == 2 and "the run to be resumed has other parameters than" in text  # its directory was found


def test_the_run_to_be_resumed_is_that_of_the_results_environment_and_scale(tmp_path, monkeypatch):
    path = result(tmp_path / "push.json")
    monkeypatch.setattr(env_from, "default_scale", lambda: "paper")  # as on a GPU
    assert env_and_scale(None, None, path) == ("PointMass", "small") == env_arguments(None, None, path, "draws", {})[:2]
    assert env_and_scale(None, "paper", path) == ("PointMass", "paper")
    assert (
        env_and_scale("Hopper", None, path) == ("Hopper", "paper") and env_and_scale("Hopper", None, "")[1] == "paper"
    )


def test_another_environment_takes_the_parameters_and_its_own_arguments(train, tmp_path, monkeypatch):
    monkeypatch.setitem(registry._FACTORIES, "Other", lambda scale: toys.point_mass(6))
    path = result(tmp_path / "push.json", kwargs={"length": 7})
    assert train("--env-from", path, "--env=Other", "--steps=12")[0] == 0
    assert load_run("a").env.episode_length == 6


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (["--env-from=absent.json"], "there is no result 'absent.json': give the JSON file that `rewax identify`"),
        (["--env-from=bad.json"], "'bad.json' is no result of this version"),
        (["--env-from=odd.json"], "PointMass has no parameter 'weight'"),
        (["--env-from-values"], "--env-from-values takes values from a result: give --env-from RESULT.json"),
        (["--env-from=nested.json"], "was fitted in an environment that had parameters of another result"),
    ],
)
def test_a_bad_result_is_one_sentence(train, tmp_path, argv, sentence):
    (tmp_path / "bad.json").write_text("{}")
    result(tmp_path / "odd.json", name="weight")
    result(tmp_path / "nested.json", kwargs={"identified": {}})
    code, text = train(*argv)
    assert code == 2 and sentence in text and "Traceback" not in text
    assert not (tmp_path / "a").exists()


def test_a_stiffness_beyond_the_substep_is_said(tmp_path):
    name = "scene.material.elasticity.youngs_modulus"
    path = result(tmp_path / "push.json", env="RollingFlat", name=name, value=700.0)
    told = rewax.make("RollingFlat", scale="small", identified=path).made_by["kwargs"]["identified"]
    for value, count in ((700.0, 1), (90000.0, 2)):
        told = {**told, "values": {name: value}}
        env = rewax.make("RollingFlat", scale="small", identified=told)
        assert len(sentences(env, told)) == count
        assert float(env.scene.material.elasticity.youngs_modulus) == value


def test_a_resumed_run_keeps_its_sensors_beside_its_parameters(tmp_path):
    path = result(tmp_path / "push.json")
    first = env_arguments(None, None, path, "draws", {})
    recorded = {"env": first.env, "env_kwargs": {**first.kwargs, "sensors": ["camera"], "resolution": 8}}
    assert env_arguments(None, None, path, "draws", recorded).kwargs == recorded["env_kwargs"]
    with pytest.raises(ValueError, match="the run to be resumed has other parameters"):
        env_arguments(None, None, path, "values", recorded)
