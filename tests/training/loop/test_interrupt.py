"""Ctrl-C before anything is trained: the process leaves at once and says what there is.

``tests/cli/test_train.py`` has later ones.
"""

import signal
import subprocess
import sys
import textwrap
import time

import pytest
import toys

SLOW = textwrap.dedent("""
    import sys, time
    import jax.numpy as jnp, toys
    from rewax.training.config import TrainConfig
    from rewax.training.loop.train import train

    def wait(*args, **kwargs):
        print("waiting", flush=True)
        time.sleep(300)

    class Slow:
        def lower(self, state):
            return self
        compile = wait

    env = toys.point_mass()
    slow = {"train_step": Slow()} if sys.argv[1] == "train_step" else {"policy": wait}
    train(toys.make_toy(env)._replace(**slow), env, TrainConfig(num_iterations=2, run_dir="a"))
""")


@pytest.mark.parametrize(
    ("compiled", "sentence", "kept", "signum"),
    [
        ("train_step", "stopped while compiling: nothing was trained, and nothing is kept", False, signal.SIGHUP),
        ("policy", "stopped before the first iteration: --resume continues", True, signal.SIGINT),
    ],
)
def test_a_signal_while_compiling_ends_the_process_at_once(
    tmp_path, sharing_programs, compiled, sentence, kept, signum
):
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW, compiled],
        cwd=tmp_path,
        env={**sharing_programs, **toys.subprocess_environment()},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    while process.stdout.readline() != "waiting\n":
        assert process.poll() is None
    while kept and not (tmp_path / "a" / "checkpoints" / "0").is_dir():  # the policy is compiled beside the train step
        time.sleep(0.5)
        assert process.poll() is None
    time.sleep(1.0)
    began = time.monotonic()
    process.send_signal(signum)
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 128 + signum and time.monotonic() - began < 20
    assert sentence in text and "Traceback" not in text
    assert (tmp_path / "a" / "checkpoints" / "0").is_dir() if kept else not (tmp_path / "a").exists()
    assert not list((tmp_path / "a").glob("*.png"))
