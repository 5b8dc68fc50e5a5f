"""Bad inputs cost one clear sentence each; ``python tests/input_fuzzer.py --cases 1500`` tries more of them."""

import pytest
from input_fuzzer import Accepted, findings, outcome, stopped_before_work

from rewax.cli import main as command_line
from rewax.training.storage.saved import load_run


def test_bad_inputs_are_refused_in_one_sentence():
    with stopped_before_work():
        found = findings(300, seed=1)
    assert not found, "\n".join(f"{finding.case}: {finding.outcome}" for finding in found)


def test_the_fuzzer_notices_what_it_looks_for():
    def raises(error):
        raise error

    assert outcome(lambda: raises(KeyError("a"))).startswith("KeyError")
    assert outcome(lambda: raises(ValueError("no remedy"))).startswith("no sentence")
    assert outcome(lambda: raises(ValueError("two: lines\nof text"))).startswith("no sentence")
    assert outcome(lambda: 0).startswith("code 0") and outcome(lambda: raises(Accepted())) == "accepted"
    with stopped_before_work(), pytest.raises(Accepted):
        command_line.main(["train", "--env=PointMass", "--scale=small"])
    with stopped_before_work() as config:
        config.write_text('{"env": "PointMass", "scale": "small", "agent": "sapo", "sapo": {}}')
        with pytest.raises(Accepted):
            load_run("run")
