"""Examples do what they say."""

import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def example(name):
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_identification_recovers_the_stiffness_and_steps_back_from_one_that_is_too_high(capsys):
    names = example("identify_material")
    # One step of 0.5 in the logarithm leads from 900 Pa to 1484 Pa, which the substeps do not allow.
    args = names["Args"](true_modulus=1150.0, first_guess=900.0, max_modulus=1200.0, iterations=9, steps=3)
    assert names["main"](args) == pytest.approx(1150.0, rel=0.02)
    text = capsys.readouterr().out
    assert "INVALID_PARAMETERS: half the step back" in text
    assert "recovered" in text


def test_identification_refuses_to_record_what_its_substeps_do_not_allow():
    names = example("identify_material")
    with pytest.raises(ValueError, match="status INVALID_PARAMETERS: give a larger max_modulus"):
        names["main"](names["Args"](true_modulus=5000.0, steps=1))
