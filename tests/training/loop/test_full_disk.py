"""A run whose disk is full ends with one sentence, and keeps what was saved before."""

import resource

import jax
import pytest
import toys

from rewax.cli import train
from rewax.cli.main import main
from rewax.training.config import TrainConfig
from rewax.training.loop.start import read_config
from rewax.training.loop.train import train as run
from rewax.training.storage import checkpoint
from rewax.training.storage.run_directory import CannotWrite, full_disk_is_one_sentence

QUIET = {"plots": False, "baselines": False, "eval_every": 0, "num_eval_episodes": 2, "checkpoint_every": 1}
AGENT = toys.make_toy(toys.point_mass())


class Limited:
    """The toy's iteration, in whose third time files that are too large begin to fail as files on a full disk do."""

    def lower(self, state):
        return self

    def compile(self, *options):
        return self

    def __call__(self, state):
        if int(state.iteration) == 2:
            resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
        return AGENT.train_step(state)


def test_a_full_disk_is_one_sentence_and_nothing_saved_is_lost(tmp_path, monkeypatch, capsys):
    def command(argv):
        config = TrainConfig(num_iterations=5, run_dir="a", **QUIET)
        run(AGENT._replace(train_step=Limited()), toys.point_mass(), config)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train, "run", command)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        code = main(["train"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    errors = capsys.readouterr().err
    assert code == 1
    assert "Traceback" not in errors and "Errno" not in errors, errors
    assert errors.splitlines()[-1] == (
        "error: a cannot be written to (File too large): free some space; the checkpoint of iteration 2 is kept, and the "
        "same command continues from it (rewax train with --resume, in Python TrainConfig(..., resume=True))"
    )
    assert checkpoint.steps(tmp_path / "a") == [1, 2] and read_config(tmp_path / "a")
    like = jax.eval_shape(AGENT.init, jax.random.key(0))
    assert int(checkpoint.restore(tmp_path / "a", like).iteration) == 2


def test_other_errors_are_passed_on():
    for error in (OSError(13, "Permission denied"), RuntimeError("No such thing")):
        with pytest.raises(type(error)), full_disk_is_one_sentence("a", lambda: "kept"):
            raise error
    with (
        pytest.raises(
            CannotWrite, match=r"^a cannot be written to \(No space left on device\): free some space; kept$"
        ),
        full_disk_is_one_sentence("a", lambda: "kept"),
    ):
        try:
            raise RuntimeError("library: No space left on device [code 7]")
        finally:
            raise ValueError("closing failed too")
