"""The validation cases at their smallest, each number within its tolerance of theory; and that a wrong number fails."""

import dataclasses

import numpy as np
import pytest

from benchmarks.validation import CASES, __main__
from benchmarks.validation.common import Check, fit_oscillation, relative


# The third notebook identifies a material too.
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name == "identification" else name for name in CASES]
)
def test_case(name):
    """Scale "tiny"; the tolerances are the cases' own: those of "full" but for toes and fronts thinner than a cell."""
    checks = CASES[name].run("tiny")["checks"]
    print(*checks, sep="\n")
    assert checks
    assert all(check.passed for check in checks), [c for c in checks if not c.passed]


def test_a_wrong_or_missing_number_fails():
    assert relative("speed", 1.02, 1.0, 0.03).passed
    assert not relative("speed", 0.96, 1.0, 0.03).passed
    assert not relative("speed", float("nan"), 1.0, 0.03).passed


def test_one_failing_case_makes_the_command_fail(monkeypatch, capsys):
    good = Check(what="good", measured=1.0, theory=1.0, error=0.0, bar=0.1)
    bad = dataclasses.replace(good, what="bad", error=0.2)

    class Module:
        def __init__(self, *checks):
            self.run = lambda scale: {"checks": checks}

    monkeypatch.setattr(__main__, "CASES", {"right": Module(good), "wrong": Module(good, bad)})
    assert __main__.main(__main__.Args(names=("right",))) == 0
    assert __main__.main(__main__.Args()) == 1
    assert "FAILS" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="there is no case absent: choose from right, wrong"):
        __main__.main(__main__.Args(names=("absent",)))


def test_oscillation_fit_finds_mean_frequency_and_decay():
    t = np.linspace(0.0, 3.0, 200)
    u = 0.7 + np.exp(-0.2 * t) * (1.5 * np.cos(6.0 * t) - 0.4 * np.sin(6.0 * t))
    fit = fit_oscillation(t, u, omega=5.6)
    np.testing.assert_allclose([fit["mean"], fit["omega"], fit["decay"]], [0.7, 6.0, 0.2], rtol=1e-6)
