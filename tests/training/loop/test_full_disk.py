"""A run whose disk is full ends with one sentence, and keeps what was saved before."""

import subprocess
import sys
import textwrap

import jax
import pytest
import toys

from rewax.training.loop.start import read_config
from rewax.training.storage import checkpoint
from rewax.training.storage.run_directory import CannotWrite, full_disk_is_one_sentence

SCRIPT = textwrap.dedent("""
    import resource, sys
    import toys
    from rewax.cli import train
    from rewax.cli.main import main
    from rewax.training.config import TrainConfig
    from rewax.training.loop.train import train as run

    def command(argv):
        agent = toys.make_toy(toys.point_mass())

        def limited(state):  # files that are too large fail as files on a full disk do
            if int(state.iteration) == 2:
                resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
            return step(state)

        step = agent.train_step
        quiet = {"plots": False, "baselines": False, "eval_every": 0, "num_eval_episodes": 2, "checkpoint_every": 1}
        config = TrainConfig(num_iterations=5, run_dir="a", **quiet)
        compiled = type("Compiled", (), {"lower": lambda *_: Lowered})
        Lowered = type("Lowered", (), {"compile": lambda *_: limited})
        run(agent._replace(train_step=compiled()), toys.point_mass(), config)

    train.run = command
    sys.exit(main(["train"]))
""")


def test_a_full_disk_is_one_sentence_and_nothing_saved_is_lost(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], cwd=tmp_path, env=toys.subprocess_environment(), capture_output=True, text=True
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr and "Errno" not in done.stderr, done.stderr
    assert done.stderr.splitlines()[-1] == (
        "error: a cannot be written to (File too large): free some space; the checkpoint of iteration 2 is kept, and the "
        "same command continues from it (rewax train with --resume, in Python TrainConfig(..., resume=True))"
    )
    assert checkpoint.steps(tmp_path / "a") == [1, 2] and read_config(tmp_path / "a")
    agent = toys.make_toy(toys.point_mass())
    assert int(checkpoint.restore(tmp_path / "a", jax.eval_shape(agent.init, jax.random.key(0))).iteration) == 2


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
