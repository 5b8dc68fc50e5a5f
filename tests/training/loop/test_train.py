"""Runs: the same bytes for one seed, the same state after a resume, nothing lost when something fails."""

import io
import json
import os
import signal

import jax
import numpy as np
import pytest
import toys
from rich.console import Console

from rewax import struct
from rewax.training.config import TrainConfig
from rewax.training.evaluation import report
from rewax.training.loop.run import RESUMED
from rewax.training.loop.train import train
from rewax.training.storage import checkpoint, leaves
from rewax.training.storage.description import read_config
from rewax.training.storage.metrics import read_csv
from rewax.training.storage.run_directory import hold

ENV = toys.point_mass()
AGENT = toys.make_toy(ENV)
QUIET = {"eval_every": 0, "baselines": False, "plots": False, "tensorboard": False, "num_eval_episodes": 2}


def run(run_dir, agent=AGENT, describe=None, **changes):
    """Train the toy; returns the result and what was printed."""
    console = Console(file=io.StringIO(), width=200)
    config = TrainConfig(**{"num_iterations": 8, "run_dir": str(run_dir), "checkpoint_every": 3, **QUIET, **changes})
    result = train(agent, ENV, config, describe=describe, console=console)
    return result, console.file.getvalue()


def bits(tree):
    """Every leaf as bytes."""
    return [leaves.to_numpy(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted run of 8 iterations."""
    path = tmp_path_factory.mktemp("whole")
    return path, run(path, eval_every=4)[0]


def test_leaves_what_a_run_is(whole):
    path, result = whole
    metrics, evaluation = read_csv(path / "metrics.csv"), read_csv(path / "eval.csv")
    np.testing.assert_array_equal(metrics["iteration"], np.arange(1, 9))
    np.testing.assert_array_equal(metrics["env_steps"], 12 * np.arange(1, 9))
    np.testing.assert_array_equal(evaluation["iteration"], [0, 4, 8])
    assert evaluation["deterministic_mean"][-1] > evaluation["deterministic_mean"][0] + 1.0  # it learns
    assert result.evaluation["deterministic_mean"] == np.float32(evaluation["deterministic_mean"][-1])
    assert read_csv(path / "timing.csv").keys() == {"iteration", "seconds", "steps_per_second"}
    assert checkpoint.latest_step(path) == 8 and result.signum == 0
    assert read_config(path)["train"]["num_iterations"] == 8


def test_one_seed_gives_the_same_bytes_another_does_not(whole, tmp_path):
    path, result = whole
    again, _ = run(tmp_path / "again", eval_every=4)
    other, _ = run(tmp_path / "other", eval_every=4, seed=1)
    for name in ("metrics.csv", "eval.csv"):
        assert (tmp_path / "again" / name).read_bytes() == (path / name).read_bytes()
        assert (tmp_path / "other" / name).read_bytes() != (path / name).read_bytes()
    assert bits(again.train_state) == bits(result.train_state) != bits(other.train_state)


@pytest.mark.parametrize("stop_at", [3, 4])
def test_a_resumed_run_equals_an_uninterrupted_one(whole, tmp_path, stop_at):
    path, result = whole
    run(tmp_path, num_iterations=stop_at, eval_every=4)
    resumed, text = run(tmp_path, resume=True, eval_every=4)
    assert f"after iteration {stop_at}" in text
    assert bits(resumed.train_state) == bits(result.train_state)
    assert (tmp_path / "metrics.csv").read_bytes() == (path / "metrics.csv").read_bytes()
    np.testing.assert_array_equal(read_csv(tmp_path / "timing.csv")["iteration"], np.arange(1, 9))


def test_resume_after_a_crash_forgets_rows_beyond_the_checkpoint(whole, tmp_path):
    path, result = whole

    def fail_at_six(state):
        if int(state.iteration) == 5:
            raise RuntimeError("power cut")
        return AGENT.train_step(state)

    class Uncompiled:
        """Stands in for a jitted function and its compiled form."""

        def lower(self, state):
            return self

        def compile(self, options):
            return fail_at_six

    with pytest.raises(RuntimeError, match="power cut"):
        run(tmp_path, agent=AGENT._replace(train_step=Uncompiled()), eval_every=4)
    assert checkpoint.latest_step(tmp_path) == 5  # what was trained is kept
    checkpoint._discard(tmp_path / "checkpoints" / "5")  # as if the machine had gone down
    assert len(read_csv(tmp_path / "metrics.csv")["iteration"]) == 5
    resumed, _ = run(tmp_path, resume=True, eval_every=4)
    assert bits(resumed.train_state) == bits(result.train_state)
    for name in ("metrics.csv", "eval.csv"):
        assert (tmp_path / name).read_bytes() == (path / name).read_bytes()


def test_train_step_is_traced_once(tmp_path):
    traces = []

    def counted(state):
        traces.append(state)
        return AGENT.train_step.__wrapped__(state)

    _, text = run(tmp_path, agent=AGENT._replace(train_step=jax.jit(counted)))
    assert len(traces) == 1
    assert "compiling train_step ..." in text and "compiled in" in text


def test_log_every_thins_the_rows(tmp_path):
    run(tmp_path, log_every=3)
    np.testing.assert_array_equal(read_csv(tmp_path / "metrics.csv")["iteration"], [3, 6])


def test_a_failing_evaluation_loses_nothing(tmp_path, monkeypatch):
    def fail(*args):
        raise RuntimeError("disk full")

    monkeypatch.setattr(report.Evaluator, "evaluate", fail)
    with pytest.raises(RuntimeError, match="disk full"):
        run(tmp_path, checkpoint_every=0, plots=True)
    assert checkpoint.latest_step(tmp_path) == 8


@pytest.mark.parametrize(
    ("field", "value"),
    [("num_iterations", 0), ("log_every", 0), ("num_eval_episodes", 0), ("keep_checkpoints", 0), ("eval_every", -1)],
)
def test_impossible_configurations_are_refused(field, value):
    with pytest.raises(ValueError, match=f"{field} is {value}: give an integer"):
        TrainConfig(**{"num_iterations": 1, "run_dir": "x", field: value})


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_finishes_the_iteration_and_resumes_bit_for_bit(whole, tmp_path, monkeypatch, signum):
    path, result = whole
    save = checkpoint.save

    def interrupted_save(run_dir, state, **kwargs):
        os.kill(os.getpid(), signum)
        return save(run_dir, state, **kwargs)

    before = signal.getsignal(signum)
    monkeypatch.setattr(checkpoint, "save", interrupted_save)
    stopped, text = run(tmp_path, plots=True)
    monkeypatch.undo()
    assert stopped.signum == signum and signal.getsignal(signum) is before
    assert int(stopped.train_state.iteration) == checkpoint.latest_step(tmp_path) == 3
    assert "stopping after this iteration" in text
    assert f"stopped after iteration 3 of 8: the same command continues from {tmp_path} {RESUMED}" in text
    assert (tmp_path / "learning_curve.png").stat().st_size > 5000
    resumed, _ = run(tmp_path, resume=True)
    assert bits(resumed.train_state) == bits(result.train_state)
    assert (tmp_path / "metrics.csv").read_bytes() == (path / "metrics.csv").read_bytes()


def test_baselines_and_pictures(tmp_path):
    _, text = run(tmp_path, num_iterations=2, baselines=True, plots=True, tensorboard=True)
    baselines = json.loads((tmp_path / "baselines.json").read_text())
    assert baselines.keys() == {"no action", "random actions", "of"}
    still = [-5 * start**2 for start in (0.5, 1.5)]
    assert still[1] <= baselines["no action"] <= still[0]
    assert "baselines: no action" in text
    for name in ("learning_curve.png", "episode.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    assert list((tmp_path / "tensorboard").glob("events*"))
    stored = (tmp_path / "baselines.json").read_bytes()
    run(tmp_path, num_iterations=3, baselines=True, resume=True)
    assert (tmp_path / "baselines.json").read_bytes() == stored
    run(tmp_path, num_iterations=4, baselines=True, resume=True, num_eval_episodes=3)
    again = json.loads((tmp_path / "baselines.json").read_text())
    assert again["of"] == {**baselines["of"], "episodes": 3} and again["random actions"] != baselines["random actions"]


def test_two_runs_in_one_directory_are_refused(tmp_path):
    with hold(tmp_path), pytest.raises(ValueError, match="is in use by process"):
        run(tmp_path)


def drop_rows(path, *numbers):
    """Remove lines of a file, the header being 0."""
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for number, line in enumerate(lines) if number not in numbers))


def test_lost_rows_are_said(tmp_path):
    run(tmp_path, num_iterations=5, eval_every=2, checkpoint_every=1)
    drop_rows(tmp_path / "metrics.csv", 2, 3)
    drop_rows(tmp_path / "eval.csv", 1)
    (tmp_path / "timing.csv").unlink()
    _, text = run(tmp_path, num_iterations=6, resume=True, eval_every=2)
    assert "metrics.csv lacks 2 of its 5 rows (iterations 2 to 3): the run goes on without them" in text
    assert "eval.csv lacks 1 of its 3 rows (iteration 0)" in text
    assert "timing.csv lacks 5 of its 5 rows (iterations 1 to 5)" in text
    np.testing.assert_array_equal(read_csv(tmp_path / "metrics.csv")["iteration"], [1, 4, 5, 6])


def test_a_whole_run_lacks_nothing(tmp_path):
    for num_iterations, resume, log_every in ((3, False, 2), (4, True, 1), (5, True, 3), (6, True, 1)):
        _, text = run(tmp_path, num_iterations=num_iterations, resume=resume, log_every=log_every, eval_every=2)
        assert "warning" not in text


def test_resume_passes_over_a_damaged_checkpoint(whole, tmp_path):
    path, result = whole
    run(tmp_path, num_iterations=6, eval_every=4)
    (tmp_path / "checkpoints" / "6" / "leaves.json").write_text("{")
    resumed, text = run(tmp_path, resume=True, eval_every=4)
    assert "checkpoints/6 is damaged and cannot be read" in text
    assert "using the one of iteration 4 before it; it is kept as 6.damaged" in text
    assert bits(resumed.train_state) == bits(result.train_state)
    assert (tmp_path / "metrics.csv").read_bytes() == (path / "metrics.csv").read_bytes()
    assert (tmp_path / "checkpoints" / "6.damaged").is_dir()


def test_drawing_never_ends_a_run(tmp_path):
    @struct.dataclass
    class Misdrawn(toys.PointMass):
        def render_shapes(self, physics):
            return [{"kind": "sphere", "middle": physics, "radius": 0.1}]

    env = Misdrawn(gain=ENV.gain)
    console = Console(file=io.StringIO(), width=200)
    config = TrainConfig(**{**QUIET, "num_iterations": 1, "run_dir": str(tmp_path), "plots": True})
    result = train(AGENT, env, config, console=console)
    text = console.file.getvalue()
    assert text.count("warning: episode.png was not drawn (ValueError: the drawing of a sphere has no 'center'") == 1
    assert "wrote" in text and not list(tmp_path.glob("episode.*"))
    assert int(result.train_state.iteration) == 1 and "deterministic_mean" in result.evaluation


@jax.jit
def shorter_and_shorter(state):
    """The toy's iteration, which counts 12, 11, 10, ... control steps."""
    new, metrics = AGENT.train_step(state)
    return new.replace(env_steps=state.env_steps + 12 - state.iteration), metrics


def test_a_run_with_a_budget_of_steps_goes_on_until_it_is_spent(tmp_path):
    agent = AGENT._replace(train_step=shorter_and_shorter)
    with pytest.raises(ValueError, match="num_steps is 2147483648: give at most 2147483647, which a run can count"):
        TrainConfig(num_iterations=4, num_steps=2**31, run_dir="a")
    result, text = run(tmp_path / "budget", agent, num_iterations=4, num_steps=48)
    assert int(result.train_state.iteration) == 5 and int(result.train_state.env_steps) == 12 + 11 + 10 + 9 + 8
    assert "iteration 5/5" in text
    by_iterations, _ = run(tmp_path / "iterations", agent, num_iterations=5)
    assert bits(result.train_state) == bits(by_iterations.train_state)
    assert int(run(tmp_path / "budget", agent, num_steps=48, resume=True)[0].train_state.iteration) == 5
    longer, _ = run(tmp_path / "budget", agent, num_steps=51, resume=True)
    assert int(longer.train_state.iteration) == 6


def test_a_budget_of_steps_changes_nothing_where_iterations_are_alike(whole, tmp_path):
    _, expected = whole
    result, _ = run(tmp_path, num_steps=8 * 12)
    assert bits(result.train_state) == bits(expected.train_state)
