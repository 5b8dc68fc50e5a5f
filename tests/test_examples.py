"""Examples do what they say."""

import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def example(name):
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_identification_recovers_the_stiffness_and_steps_back_from_one_that_is_too_high(capsys):
    names = example("identify_material")
    # The first step leads from 900 Pa to some 1190 Pa; the substeps are stable up to 1148 Pa.
    args = {"true_modulus": 1100.0, "first_guess": 900.0, "max_modulus": 1140.0, "step_factor": 3.0}
    assert names["main"](names["Args"](**args, iterations=8, steps=3)) == pytest.approx(1100.0, rel=0.01)
    text = capsys.readouterr().out
    assert "INVALID_PARAMETERS: half the step back" in text


def test_identification_refuses_to_record_what_its_substeps_do_not_allow():
    names = example("identify_material")
    with pytest.raises(ValueError, match=r"status .*INVALID_PARAMETERS: give a larger max_modulus"):
        names["main"](names["Args"](true_modulus=5000.0, steps=1))
