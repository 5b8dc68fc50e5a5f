"""``rewax check``: a sentence and an exit code."""

import jax.numpy as jnp
import pytest
import toys

from rewax import struct
from rewax.agents import registry as algorithms
from rewax.agents.config import RunConfig
from rewax.agents.registry import Algorithm
from rewax.cli.main import main
from rewax.envs import registry


@struct.dataclass
class Forgetful(toys.PointMass):
    """Its reward does not depend on what was done."""

    def step(self, state, action):
        return self.after(state, state.physics + 0.0 * action)


@struct.dataclass
class Broken(toys.PointMass):
    """Its step raises an exception."""

    def step(self, state, action):
        return self.after(state, state.physics + jnp.zeros(3) @ action)


@struct.dataclass
class Silent(toys.PointMass):
    """It observes nothing, which fails in the code that checks it."""

    def reset(self, key):
        return super().reset(key).replace(obs=None)


@pytest.fixture
def registered():
    registry._FACTORIES["Broken"] = lambda scale: Broken(gain=jnp.float32(0.5))
    registry._FACTORIES["Point"] = lambda scale: toys.point_mass()
    registry._FACTORIES["Forgetful"] = lambda scale: Forgetful(gain=jnp.float32(0.5))
    yield
    del registry._FACTORIES["Broken"], registry._FACTORIES["Point"], registry._FACTORIES["Forgetful"]


def test_one_that_keeps_the_protocol(registered, capsys):
    assert main(["check", "--env", "Point"]) == 0
    assert capsys.readouterr().out.endswith("Point at scale small keeps the protocol\n")


def test_one_that_does_not(registered, capsys):
    assert main(["check", "--env", "Forgetful", "--no-whole-episode"]) == 1
    assert "problem: " in (said := capsys.readouterr().err) and "gradient" in said


def test_an_exception_of_the_environment_is_a_sentence_with_its_line(registered, capsys):
    assert main(["check", "--env", "Broken"]) == 1
    said = capsys.readouterr().err
    assert said.startswith("problem: the check of Broken failed at ") and said.count("\n") == 1
    assert "test_check.py:" in said and "jnp.zeros(3) @ action" in said and "TypeError" in said


def test_an_exception_of_what_a_method_returns_is_a_sentence(monkeypatch, capsys):
    monkeypatch.setitem(registry._FACTORIES, "Silent", lambda scale: Silent(gain=jnp.float32(0.5)))
    assert main(["check", "--env", "Silent"]) == 1
    said = capsys.readouterr().err
    assert said.startswith("problem: the check of Silent failed: TypeError: ") and said.count("\n") == 1
    assert said.endswith(": look at what its methods return\n")


def make_absent(env, config):
    """A toy with a metric that is NaN."""
    toy = toys.make_toy(env)

    def train_step(state):
        state, metrics = toy.train_step(state)
        return state, {**metrics, "alpha": jnp.float32(jnp.nan)}

    return toy._replace(train_step=train_step)


def test_an_algorithm(registered, capsys, monkeypatch):
    absent = Algorithm(make_absent, RunConfig, lambda env_name, scale: RunConfig())
    monkeypatch.setitem(algorithms._ALGORITHMS, "absent", lambda: absent)
    assert main(["check", "--env", "Point", "--algo", "absent"]) == 1
    assert "problem: metric 'alpha' is nan: look for" in capsys.readouterr().err
    assert main(["check", "--env", "Point", "--algo", "absent", "--may-be-nan", "return", "alpha"]) == 0
    assert capsys.readouterr().out.endswith("absent on Point at scale small keeps the protocol\n")


def test_wrong_usage(capsys):
    assert main(["check", "--env", "RolingFlat"]) == 2
    assert "RollingFlat" in capsys.readouterr().err
    assert main(["check", "--env", "RollingFlat", "--algo", "sapoo"]) == 2
    assert "did you mean 'sapo'" in capsys.readouterr().err
    assert main(["check", "--env", "RollingFlat", "--algo", "sapo", "--in-cpp"]) == 2
    assert (
        "--in-cpp, --no-whole-episode and --no-compare-gradient belong to the check of an environment"
        in capsys.readouterr().err
    )
    assert main(["check", "--env", "RollingFlat", "--may-be-nan", "alpha"]) == 2
    assert "--may-be-nan names metrics of an algorithm: also give --algo" in capsys.readouterr().err
    assert main(["check"]) == 2
    assert "rewax check needs the option --env" in capsys.readouterr().err
