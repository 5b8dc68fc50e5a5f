"""What a run begins with, and what it refuses to go on with."""

import dataclasses
import io
import json
import shutil
from typing import ClassVar

import jax
import pytest
import toys
from rich.console import Console

from rewax import struct
from rewax.agents.apg import APGConfig, make_apg
from rewax.envs.base import ArraySpec
from rewax.training.config import TrainConfig
from rewax.training.loop.seeds import train_seeds
from rewax.training.loop.train import train

ENV = toys.point_mass()


@dataclasses.dataclass(frozen=True)
class Options:
    """Of the toy."""

    width: int = 1
    rate: float = 0.1


AGENTS = {width: toys.make_toy(ENV, width=width) for width in (1, 2)}


def run(run_dir, *, options=None, describe=None, **changes):
    """One iteration of the toy, named ``toy`` if it has options; returns what was printed."""
    console = Console(file=io.StringIO(), width=200)
    quiet = {"eval_every": 0, "baselines": False, "plots": False, "tensorboard": False, "num_eval_episodes": 2}
    config = TrainConfig(**{"num_iterations": 1, "run_dir": str(run_dir), **quiet, **changes})
    agent = AGENTS[options.width if options else 1]
    if options:
        agent = agent._replace(name="toy", config=options)
    train(agent, ENV, config, describe=describe, console=console)
    return console.file.getvalue()


def test_a_directory_with_a_run_is_refused(tmp_path):
    run(tmp_path)
    with pytest.raises(ValueError, match=r"holds a run already: resume it .*resume=True.* or choose another directory"):
        run(tmp_path)
    with pytest.raises(ValueError, match="there is no run directory"):
        run(tmp_path / "nowhere", resume=True)
    shutil.rmtree(tmp_path / "checkpoints")
    with pytest.raises(ValueError, match="holds the metrics of a run, but no checkpoint: choose another directory"):
        run(tmp_path)
    with pytest.raises(ValueError, match="run_dir is '': name a directory"):
        TrainConfig(num_iterations=1, run_dir="")


def test_a_resumed_run_did_not_begin_with_another_one(tmp_path):
    run(tmp_path)
    with pytest.raises(ValueError, match=r"holds a run that began with fresh networks: resume it without --init-from"):
        run(tmp_path, resume=True, init_from=str(tmp_path))
    assert json.loads((tmp_path / "config.json").read_text())["train"]["init_from"] == ""


def test_strays_are_no_run(tmp_path):
    (tmp_path / "checkpoints" / "9").mkdir(parents=True)
    (tmp_path / "checkpoints" / ".DS_Store").write_text("x")
    run(tmp_path)


def test_resuming_another_environment_is_refused_and_changes_are_told(tmp_path):
    describe = {"env": "PointMass", "scale": "small", "agent": "toy", "toy": {"rate": 0.1}}
    run(tmp_path, describe=describe)
    for name, other, flag in (("scale", "paper", "--scale"), ("agent", "shac", "--algo")):
        old = describe[name]
        with pytest.raises(
            ValueError, match=f"holds a run with {name} {old}, not {other}: resume it with {flag} {old}"
        ):
            run(tmp_path, resume=True, describe={**describe, name: other})
    text = run(tmp_path, resume=True, num_iterations=2, describe={"env": "PointMass", "toy": {"rate": 0.2}})
    assert "note: resuming with toy.rate 0.2, it was 0.1" in text
    config = tmp_path / "config.json"
    stored = json.loads(config.read_text())
    stored["versions"]["jax"] = "0.9.0"
    config.write_text(json.dumps(stored))
    text = run(
        tmp_path, resume=True, num_iterations=3, describe={"env": "PointMass", "env_kwargs": {"num_substeps": 8}}
    )
    assert "note: resuming with env_kwargs.num_substeps 8, it was its default" in text
    assert f"note: resuming with jax {jax.__version__}, it was 0.9.0" in text


@dataclasses.dataclass(frozen=True)
class StartOptions(Options):
    """Of which one acts at the start alone."""

    num_envs: int = 4
    horizon: int = 3
    start_only: ClassVar[frozenset[str]] = frozenset({"rate"})


def test_options_of_the_start_have_no_effect_on_a_resumed_run(tmp_path):
    run(tmp_path, options=StartOptions())
    text = run(tmp_path, options=StartOptions(rate=0.2), resume=True, num_iterations=2)
    assert "note: toy.rate 0.2 has no effect on a run that began with 0.1: it goes on from there" in text
    assert "resuming with" not in text


def test_a_run_with_more_steps_than_it_can_count_is_refused(tmp_path):
    most = (2**31 - 1) // 12
    with pytest.raises(ValueError, match=rf"num_iterations is {most + 1} with 12 control .*: give at most {most}, be"):
        run(tmp_path, options=StartOptions(), num_iterations=most + 1)


def test_resuming_with_another_network_names_the_options(tmp_path):
    run(tmp_path, options=Options())
    with pytest.raises(ValueError) as caught:
        run(tmp_path, options=Options(width=2, rate=0.2), resume=True)
    message = str(caught.value)
    assert "holds a run with toy.width 1 (given: 2), toy.rate 0.1 (given: 0.2)" in message
    assert "resume it with the stored ones" in message and ".bias" not in message
    assert "note: resuming with toy.rate" in run(tmp_path, options=Options(rate=0.2), resume=True, num_iterations=2)


def test_resuming_with_other_shapes_names_the_field_where_no_option_differs(tmp_path):
    run(tmp_path)
    match = r"holds \.bias as float32 of shape \(1,\), .* needs float32 of shape \(2,\)"
    with pytest.raises(ValueError, match=match):
        train(AGENTS[2], ENV, TrainConfig(num_iterations=1, run_dir=str(tmp_path), resume=True))


@struct.dataclass
class Plane(toys.PointMass):
    """A point mass with two actions, of which the second does nothing, or with another observation."""

    actions: int = struct.static_field(default=2)
    name: str = struct.static_field(default="x")

    @property
    def action_spec(self):
        return ArraySpec((self.actions,), -1.0, 1.0)

    @property
    def observation_spec(self):
        return {self.name: ArraySpec((1,))}


@pytest.mark.parametrize(
    ("env", "sentence"),
    [
        (Plane(gain=0.5), "env takes actions of shape (2,), but the agent was built for (1,): give the environment of"),
        (Plane(gain=0.5, name="y"), "env observes y (1,), but the agent was built for x (1,): give the environment of"),
    ],
)
def test_an_environment_that_is_not_the_agents_is_refused_before_training(tmp_path, env, sentence):
    agent = make_apg(ENV, APGConfig(num_envs=2, horizon=3, actor_widths=(4,), vector_features=4))
    with pytest.raises(ValueError) as caught:
        train(agent, env, TrainConfig(num_iterations=1, run_dir=str(tmp_path / "run")))
    assert str(caught.value).startswith(sentence) and not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"agent": "sapo"}, "agent is 'sapo': give an agent, make_sapo(env) for example"),
        ({"env": None}, "env is None: give an environment"),
        ({"config": {}}, "config is {}: give a TrainConfig"),
        ({"describe": 3}, "describe is 3: give entries of config.json by name, or None"),
    ],
)
def test_arguments_of_another_type_are_refused(tmp_path, change, sentence):
    config = TrainConfig(num_iterations=1, run_dir=str(tmp_path / "run"))
    given = {"agent": AGENTS[1], "env": ENV, "config": config, "describe": None, **change}
    for use in (train, lambda config, **rest: train_seeds(configs=[config], **rest)):
        with pytest.raises(ValueError) as caught:
            use(**given)
        assert str(caught.value).startswith(sentence)
    assert not (tmp_path / "run").exists()
