"""A run directory serves one process, and what is wrong with it is one sentence, before anything compiles."""

import os
import subprocess
import sys

import pytest
import toys

from rewax.training.config import TrainConfig
from rewax.training.loop.train import train
from rewax.training.storage.run_directory import hold


def refused(run_dir, *words, **kwargs):
    """``hold`` raises ValueError with one sentence that holds the words and a remedy."""
    with pytest.raises(ValueError) as caught, hold(run_dir, **kwargs):
        pass
    message = str(caught.value)
    assert "\n" not in message
    for word in (*words, ": "):
        assert word in message


def test_one_holder_at_a_time(tmp_path):
    with hold(tmp_path / "run"):
        refused(tmp_path / "run", f"is in use by process {os.getpid()} on ", "choose another directory")
        with hold(tmp_path / "other"):
            pass
    with hold(tmp_path / "run"):
        pass


def test_a_refusal_leaves_nothing_behind(tmp_path):
    with pytest.raises(ValueError, match=r"^refused$"), hold(tmp_path / "runs" / "new"):
        raise ValueError("refused")
    assert not list(tmp_path.iterdir())
    (tmp_path / "there").mkdir()
    with pytest.raises(ValueError, match=r"^refused$"), hold(tmp_path / "there"):
        raise ValueError("refused")
    assert list(tmp_path.rglob("*")) == [tmp_path / "there"]
    with pytest.raises(ValueError, match=r"^failed later$"), hold(tmp_path / "runs" / "begun"):
        (tmp_path / "runs" / "begun" / "config.json").write_text("{}")
        raise ValueError("failed later")
    assert (tmp_path / "runs" / "begun" / "config.json").is_file()
    with hold(tmp_path / "used"):
        refused(tmp_path / "used", "is in use by process")
        assert (tmp_path / "used" / ".lock").is_file()


def test_the_lock_ends_with_its_process(tmp_path):
    script = (
        "import pathlib, sys, time; from rewax.training.storage.run_directory import hold\n"
        "with hold(pathlib.Path(sys.argv[1])): print('held', flush=True); time.sleep(300)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)], env=toys.subprocess_environment(), stdout=subprocess.PIPE
    )
    assert process.stdout.readline() == b"held\n"
    refused(tmp_path, f"is in use by process {process.pid} on ")
    process.kill()
    process.wait()
    with hold(tmp_path):
        pass
    process.stdout.close()


def test_impossible_places(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    refused(tmp_path / "file", "is not a directory", "choose another directory")
    refused(tmp_path / "file" / "run", "cannot be written to (Not a directory)", "choose another directory")
    refused(tmp_path / "nowhere", "there is no run directory", must_exist=True)
    assert not (tmp_path / "nowhere").exists()
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "checkpoints").write_text("x")
    refused(tmp_path / "a", "checkpoints is not a directory")
    (tmp_path / "b" / "config.json").mkdir(parents=True)
    refused(tmp_path / "b", "config.json is a directory")
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write everywhere
    refused(tmp_path / "c", "cannot be written to (Permission denied)", "choose another directory")


def test_nothing_is_computed_in_a_directory_that_cannot_be_used(tmp_path):
    def init(key):
        raise AssertionError("traced")

    agent = toys.make_toy(toys.point_mass())._replace(init=init)
    (tmp_path / "file").write_text("x")

    def attempt(run_dir, **changes):
        train(agent, toys.point_mass(), TrainConfig(num_iterations=1, run_dir=str(run_dir), **changes))

    with pytest.raises(ValueError, match="is not a directory"):
        attempt(tmp_path / "file")
    with hold(tmp_path / "run"), pytest.raises(ValueError, match="is in use by process"):
        attempt(tmp_path / "run")
    (tmp_path / "run" / "config.json").write_text("null")
    with pytest.raises(ValueError, match=r"config\.json holds null, not named entries"):
        attempt(tmp_path / "run", resume=True)
