"""``rewax train --sensors``: ``config.json`` and ``--resume`` keep them, ``rewax envs`` lists them."""

import pytest
import seeing_toys
import toys
from toys import QUICK_RUN as QUICK
from toys import ToyConfig
from toys import make_configured as make

from rewax.agents import registry as agents
from rewax.agents.registry import Algorithm
from rewax.cli.main import main as command
from rewax.envs import registry
from rewax.training.storage.description import read_config
from rewax.training.storage.saved import load_run


@pytest.fixture
def train(tmp_path, monkeypatch, capfd):
    """``train(*argv)``: exit code and output of ``rewax train`` with a toy algorithm, in an empty directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(registry._FACTORIES, "Ball", lambda scale, length=5: seeing_toys.visible(length))
    monkeypatch.setitem(registry._FACTORIES, "PointMass", lambda scale: toys.point_mass())
    monkeypatch.setitem(agents._ALGORITHMS, "toy", lambda: Algorithm(make, ToyConfig, lambda env, scale: ToyConfig()))

    def call(*argv):
        code = command(["train", "--algo=toy", "--run-dir=a", *argv, *QUICK])
        return code, " ".join("".join(capfd.readouterr()).split())

    return call


def test_a_run_keeps_its_sensors(train):
    code, text = train("--env=Ball", "--steps=12", "--sensors", "camera", "cloud", "--resolution=8")
    assert code == 0 and "camera (8, 8, 1), cloud (64, 3); --toy.observe chooses those of the policy" in text, text
    kwargs = read_config("a")["env_kwargs"]
    assert kwargs == {"sensors": ["camera", "cloud"], "resolution": 8}
    code, text = train("--env=Ball", "--steps=24", "--resume")
    assert code == 0 and "a after iteration 1" in text, text
    assert read_config("a")["env_kwargs"] == kwargs
    assert load_run("a").env.observation_spec["camera"].shape == (8, 8, 1)
    code, text = train("--env=Ball", "--steps=36", "--resume", "--sensors", "camera")
    assert (
        code == 2 and "a holds a run with sensors ['camera', 'cloud', 8], not ['camera', 8]: resume it with its" in text
    )


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (["--env=Ball", "--resolution=8"], "--resolution is that of sensors: name them, for example --sensors camera"),
        (["--env=Ball", "--sensors"], "--sensors stands without names: give some, for example --sensors camera"),
        (["--env=Ball", "--sensors", "radar"], "there is no sensor named 'radar': known are camera, cloud, labels"),
        (["--env=PointMass", "--sensors", "camera"], "PointMass has neither a default_camera nor world(physics, up)"),
    ],
)
def test_bad_sensors_are_a_sentence(train, argv, sentence):
    code, text = train("--steps=12", *argv)
    assert code == 2 and sentence in text, text


def test_envs_lists_sensors(train, capfd):
    assert command(["envs", "Ball", "PointMass"]) == 0
    lines = [line.split() for line in capfd.readouterr().out.splitlines() if line.strip().startswith("sensors")]
    assert lines == [["sensors", "camera,", "cloud,", "labels"], ["sensors", "none"]]
