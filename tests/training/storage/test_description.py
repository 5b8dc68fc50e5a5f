"""What ``config.json`` says, and what it cannot say."""

import dataclasses
import json
import re
import types

import jax
import pytest
import toys

from rewax.lowering import machine
from rewax.lowering.report import Decision
from rewax.training.storage import description
from rewax.training.storage.description import (
    append_lowering,
    changes,
    describe_run,
    provenance,
    provenance_of_parts,
    read_config,
    write_config,
    write_environment,
)


@dataclasses.dataclass(frozen=True)
class Options:
    """Of the toy."""

    widths: tuple[int, ...] = (4, 2)


def test_configuration_is_kept(tmp_path):
    write_config(tmp_path, {"env": "PointMass", "sizes": (1, 2), "rate": 0.5})
    config = read_config(tmp_path)
    assert {name: config[name] for name in ("env", "sizes", "rate")} == {
        "env": "PointMass",
        "sizes": [1, 2],
        "rate": 0.5,
    }
    assert config["versions"]["jax"] == jax.__version__
    assert read_config(tmp_path / "nowhere") == {}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [("{", "not readable as JSON"), ("null", "holds null, not named"), ("[1]", r"holds \[1\], not"), ("3", "holds 3,")],
)
def test_other_contents_are_said(tmp_path, text, sentence):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ValueError, match=sentence):
        read_config(tmp_path)


def test_agent_and_environment_describe_themselves():
    agent = toys.make_toy(toys.point_mass())._replace(name="toy", config=Options())
    env = types.SimpleNamespace(made_by={"env": "PointMass", "scale": "small", "kwargs": {"gain": 2.0}})
    made = {"env": "PointMass", "scale": "small", "env_kwargs": {"gain": 2.0}}
    assert describe_run(agent, env) == {**made, "agent": "toy", "toy": Options()}
    assert describe_run(agent, env, {"scale": "paper", "seed": 1})["scale"] == "paper"
    assert describe_run(agent, toys.point_mass()) == {"agent": "toy", "toy": Options()}
    assert describe_run(agent._replace(name=""), toys.point_mass(), {"a": 1}) == {"a": 1}
    odd = types.SimpleNamespace(made_by={"env": "PointMass", "scale": "small", "kwargs": {"gain": object()}})
    assert "env" not in describe_run(agent, odd)  # JSON cannot say how to build it


def test_changes_are_those_of_entries_that_both_have():
    old = json.loads(json.dumps(description.plain({"toy": Options(), "seed": 1, "gone": 0})))
    new = description.plain({"toy": Options(widths=(8, 2)), "seed": 1, "more": 0})
    assert changes(old, new) == [("toy.widths", [4, 2], [8, 2])]


def test_the_environment_of_a_run_can_be_installed_again(tmp_path):
    write_environment(tmp_path)
    head, cpp, *packages = (tmp_path / "environment.txt").read_text().splitlines()
    assert head.startswith("# Python 3.") and jax.devices()[0].device_kind in head
    assert cpp == f"# C++ on a CPU: {'on' if machine.why_in_xla() is None else 'off'}"
    assert f"jax=={jax.__version__}" in packages and len(packages) > 10


def test_the_environment_of_a_run_says_what_ran_in_cpp(tmp_path):
    write_environment(tmp_path)
    decisions = [Decision("a.law", "value", None), Decision("a.law", "cotangent", "it has the operation sort")]
    append_lowering(tmp_path, decisions * 2)
    last = (tmp_path / "environment.txt").read_text().splitlines()[-2:]
    assert last == [
        "# a.law, the reverse derivative (VJP): XLA, for it has the operation sort",
        "# a.law, the value: C++",
    ]


def test_provenance_says_with_what_a_result_was_made(monkeypatch):
    found = provenance()
    assert set(found) == {"commit", "processor", "cpp", "jax"} and found["jax"] == jax.__version__
    assert found["cpp"] in ("on", "off") and " x " in found["processor"]
    assert re.fullmatch(r"[0-9a-f]{12}\+?|", found["commit"])
    monkeypatch.setenv("PATH", "")  # no git
    assert provenance()["commit"] == ""


def test_a_run_has_a_part_for_each_place_where_it_was_trained(monkeypatch):
    here, there, last = ({"commit": commit, "processor": "1 x A", "cpp": "on", "jax": "1"} for commit in "abc")
    monkeypatch.setattr(description, "provenance", lambda: here)
    first = provenance_of_parts({}, 0)
    assert first == [{"after": 0, **here}] == provenance_of_parts({"provenance": first}, 5)
    monkeypatch.setattr(description, "provenance", lambda: there)
    both = provenance_of_parts({"provenance": first}, 5)
    assert both == [*first, {"after": 5, **there}]
    assert provenance_of_parts({"provenance": both}, 3) == [*first, {"after": 3, **there}]  # from an older checkpoint
    monkeypatch.setattr(description, "provenance", lambda: last)
    assert provenance_of_parts({"provenance": both}, 5) == [*first, {"after": 5, **last}]  # nothing was trained there
    for by_hand in ("me", [1, {"after": "x"}]):
        assert provenance_of_parts({"provenance": by_hand}, 3) == [{"after": 3, **last}]
