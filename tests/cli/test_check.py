"""``rewax check``: a sentence and an exit code."""

import jax.numpy as jnp
import pytest
import toys

from rewax import struct
from rewax.cli.main import main
from rewax.envs import registry


@struct.dataclass
class Forgetful(toys.PointMass):
    """Its reward does not depend on what was done."""

    def step(self, state, action):
        return self.after(state, state.physics + 0.0 * action)


@pytest.fixture
def registered():
    registry._FACTORIES["Point"] = lambda scale: toys.point_mass()
    registry._FACTORIES["Forgetful"] = lambda scale: Forgetful(gain=jnp.float32(0.5))
    yield
    del registry._FACTORIES["Point"], registry._FACTORIES["Forgetful"]


def test_one_that_keeps_the_protocol(registered, capsys):
    assert main(["check", "--env", "Point"]) == 0
    assert capsys.readouterr().out.endswith("Point at scale small keeps the protocol\n")


def test_one_that_does_not(registered, capsys):
    assert main(["check", "--env", "Forgetful", "--no-whole-episode"]) == 1
    assert "problem: " in (said := capsys.readouterr().err) and "gradient" in said


def test_an_algorithm(registered, capsys):
    """One whose metrics are NaN while its first phase lasts."""
    arguments = ["check", "--env", "Point", "--algo", "sapo_from_demonstrations"]
    assert main(arguments) == 1
    assert "problem: metric 'entropy' is nan: look for" in capsys.readouterr().err
    assert main([*arguments, "--may-be-nan", "return", "entropy", "temperature"]) == 0
    assert "sapo_from_demonstrations on Point at scale small keeps the protocol" in capsys.readouterr().out


def test_wrong_usage(capsys):
    assert main(["check", "--env", "RolingFlat"]) == 2
    assert "RollingFlat" in capsys.readouterr().err
    assert main(["check", "--env", "RollingFlat", "--algo", "sapoo"]) == 2
    assert "did you mean 'sapo'" in capsys.readouterr().err
    assert main(["check"]) == 2
    assert "rewax check needs the option --env" in capsys.readouterr().err
