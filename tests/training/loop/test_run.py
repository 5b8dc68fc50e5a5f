"""A run that fails stops, says why, and keeps the last training state that is worth keeping."""

import io

import jax
import jax.numpy as jnp
import numpy as np
import toys
from rich.console import Console

from rewax import struct
from rewax.status import Status
from rewax.training.config import TrainConfig
from rewax.training.loop import progress
from rewax.training.loop.train import train
from rewax.training.storage import checkpoint
from rewax.training.storage.metrics import read_csv

QUIET = {"eval_every": 0, "baselines": False, "plots": False, "tensorboard": False, "num_eval_episodes": 2}


@struct.dataclass
class Fragile(toys.PointMass):
    """A point mass whose second step fails if it is ``broken``; the last step of an episode breaks the CFL limit."""

    broken: bool = struct.static_field(default=True)

    def step(self, state, action):
        x = state.physics + self.gain * jnp.clip(action, -1.0, 1.0)
        x = jnp.where(self.broken & (state.step_count == 1), jnp.nan, x)
        last = state.step_count + 1 == self.length
        return self.after(state, x, status=jnp.where(last, int(Status.CFL), int(Status.OK)))


FRAGILE, SOUND = Fragile(gain=jnp.float32(0.5)), Fragile(gain=jnp.float32(0.5), broken=False)
AGENT, SOUND_AGENT = toys.make_toy(FRAGILE), toys.make_toy(SOUND)


def run(run_dir, env, agent, **changes):
    """Train; returns the result and what was printed."""
    console = Console(file=io.StringIO(), width=200)
    config = TrainConfig(**{"num_iterations": 12, "run_dir": str(run_dir), "checkpoint_every": 1, **QUIET, **changes})
    result = train(agent, env, config, console=console)
    return result, console.file.getvalue()


def test_a_run_whose_episodes_fail_stops_and_says_so(tmp_path):
    result, text = run(tmp_path, FRAGILE, AGENT, failure_window=4)
    assert int(result.train_state.iteration) == 4 == checkpoint.latest_step(tmp_path)
    assert "warning: in iteration 1 environment 0 failed because physics was not finite" in text
    assert "failed after iteration 4 of 12: " in text and "episodes failed numerically in the last 4 iterations" in text
    assert "evaluation after" not in text and result.evaluation == {}
    assert "episodes failed numerically" in result.failure


def test_a_failing_run_to_its_end_is_no_success(tmp_path):
    result, text = run(tmp_path, FRAGILE, AGENT, num_iterations=2)
    assert "episodes failed numerically in the last 2 iterations" in result.failure and result.failure in text
    assert "sampled (2 of 2 episodes failed), " in text and "deterministic (2 of 2 episodes failed)" in text
    assert "warning: 4 of 4 episodes failed numerically and ended early" in text
    assert result.evaluation["sampled_failed"] == 2


def test_a_share_of_one_lets_it_go_on(tmp_path):
    result, text = run(tmp_path, FRAGILE, AGENT, num_iterations=4, failure_window=2, max_failed_share=1.0)
    assert result.failure == "" and int(result.train_state.iteration) == 4
    assert "warning: 4 of 4 episodes failed" in text


def test_a_healthy_run_says_nothing(tmp_path):
    result, text = run(tmp_path, SOUND, SOUND_AGENT, num_iterations=3, failure_window=1)
    assert result.failure == "" and "failed" not in text and "warning" not in text
    assert "status of 4 episodes: CFL in 4" in text
    evaluation = read_csv(tmp_path / "eval.csv")
    assert (evaluation["sampled_status/CFL"][-1], evaluation["deterministic_status/NAN"][-1]) == (2, 0)


def stepping(change):
    """The sound agent, whose state and metrics ``change`` alters after an iteration."""

    @jax.jit
    def train_step(state):
        return change(*SOUND_AGENT.train_step(state))

    return SOUND_AGENT._replace(train_step=train_step)


def test_a_poisoned_training_state_is_never_kept(tmp_path):
    def poison(state, metrics):
        return state.replace(bias=jnp.where(state.iteration == 5, jnp.nan, state.bias)), metrics

    result, text = run(tmp_path, SOUND, stepping(poison), keep_checkpoints=2)
    assert "failed after iteration 4 of 12: iteration 5 made .bias of the training state infinite or NaN" in text
    assert int(result.train_state.iteration) == 4 and np.isfinite(result.train_state.bias).all()
    assert checkpoint.steps(tmp_path) == [3, 4]
    assert np.isfinite(checkpoint.restore(tmp_path, result.train_state).bias).all()
    assert result.evaluation == {} and result.failure


def test_a_consumed_training_state_is_restored_without_the_other_processes(tmp_path, monkeypatch):
    """To place arrays on devices of other processes is a command to them, which nobody sends."""

    def poison(state, metrics):
        return state.replace(bias=jnp.where(state.iteration == 3, jnp.nan, state.bias)), metrics

    def restored(run_dir, like):
        assert [leaf for leaf in jax.tree.leaves(like) if getattr(leaf, "sharding", None) is not None] == []
        return restore(run_dir, like)

    restore = checkpoint.restore
    monkeypatch.setattr(checkpoint, "restore", restored)
    result, _ = run(tmp_path, SOUND, stepping(poison)._replace(consumes=True), num_iterations=4)
    assert "iteration 3 made .bias" in result.failure and int(result.train_state.iteration) == 2


def test_critics_whose_loss_is_nan_stop_the_run(tmp_path):
    def lose(state, metrics):
        return state, {**metrics, "critic_loss": jnp.where(state.iteration > 3, jnp.nan, 1.0)}

    result, text = run(tmp_path, SOUND, stepping(lose), failure_window=2)
    assert int(result.train_state.iteration) == 5
    assert "critic_loss was not finite in 2 of the last 2 iterations" in text


def test_the_last_checkpoint_before_the_failures_stays(tmp_path):
    def fail_later(state, metrics):
        failed = jnp.where(state.iteration > 3, 12, 0)
        return state, {**metrics, "failed_episodes": failed, "episodes": 12}

    result, text = run(tmp_path, SOUND, stepping(fail_later), failure_window=6, keep_checkpoints=1)
    assert int(result.train_state.iteration) == 7  # with 4 of the last 6 iterations
    assert checkpoint.steps(tmp_path) == [3, 7]
    assert "the last checkpoint from before the failures is that of iteration 3" in text


def test_a_status_bit_is_explained_once_and_counted(tmp_path):
    _, text = run(tmp_path, SOUND, SOUND_AGENT, num_iterations=5)
    counts = read_csv(tmp_path / "metrics.csv")["status/CFL"]
    warnings = [line for line in text.splitlines() if line.startswith("status: CFL in ")]
    assert len(warnings) == 1 and "remedy: shorter substeps or softer contacts" in warnings[0]
    assert counts.sum() > 0 and f"status of all steps: CFL in {int(counts.sum())} steps\n" in text and "NAN" not in text


def test_lines_have_only_new_counts_of_a_status_bit(monkeypatch):
    monkeypatch.setattr(progress, "_SECONDS_BETWEEN_LINES", 0.0)
    console = Console(file=io.StringIO(), width=200)
    report = progress.ProgressReport(console, 60, 0)
    for i in range(1, 61):
        report.update(i, i, {"status/INACTIVE_NODES": {1: 47, 30: 2}.get(i, 0)}, 1.0)
    report.close()
    lines = [line for line in console.file.getvalue().splitlines() if "INACTIVE_NODES" in line]
    assert [line.split("  ")[0] for line in lines[1:]] == [
        "iteration 30/60",
        "status of all steps: INACTIVE_NODES in 49 steps",
    ]
    assert "remedy: a larger max_active_nodes" in lines[0] and "INACTIVE_NODES in 2 more steps" in lines[1]


def test_checkpoints_can_be_a_time_apart(tmp_path):
    run(tmp_path / "all", SOUND, SOUND_AGENT, num_iterations=4, keep_checkpoints=9)
    run(tmp_path / "last", SOUND, SOUND_AGENT, num_iterations=4, keep_checkpoints=9, checkpoint_seconds=1e6)
    assert checkpoint.steps(tmp_path / "all") == [1, 2, 3, 4] and checkpoint.steps(tmp_path / "last") == [4]


def failing_after(iteration):
    """An agent all of whose episodes fail after an iteration, according to its metrics."""

    def train_step(state):
        new, metrics = SOUND_AGENT.train_step(state)
        failed = jnp.where(new.iteration > iteration, 4, 0)
        return new, {**metrics, "failed_episodes": failed, "episodes": jnp.maximum(metrics["episodes"], failed)}

    return SOUND_AGENT._replace(train_step=jax.jit(train_step))


FAILS_LATE = failing_after(6)


def test_a_resumed_run_stops_where_it_would_have_and_keeps_its_healthy_checkpoint(tmp_path):
    options = {"keep_checkpoints": 2, "failure_window": 8, "num_iterations": 40}
    whole, _ = run(tmp_path / "whole", SOUND, FAILS_LATE, **options)
    run(tmp_path / "parts", SOUND, FAILS_LATE, **{**options, "num_iterations": 9})
    parts, _ = run(tmp_path / "parts", SOUND, FAILS_LATE, **options, resume=True)
    assert int(parts.train_state.iteration) == int(whole.train_state.iteration) == 10
    assert parts.failure == whole.failure
    for part in ("whole", "parts"):
        assert checkpoint.steps(tmp_path / part) == [6, 9, 10] and checkpoint.healthy_step(tmp_path / part) == 6


def test_an_evaluation_before_the_first_iteration_keeps_the_healthy_checkpoint(tmp_path):
    options = {"keep_checkpoints": 2, "failure_window": 8}
    run(tmp_path, SOUND, FAILS_LATE, **{**options, "num_iterations": 9})
    run(tmp_path, SOUND, FAILS_LATE, **{**options, "num_iterations": 40, "eval_every": 9}, resume=True)
    assert checkpoint.steps(tmp_path) == [6, 9, 10] and checkpoint.healthy_step(tmp_path) == 6


def test_a_failed_run_that_is_resumed_has_a_window_of_its_own(tmp_path):
    options = {"keep_checkpoints": 2, "failure_window": 8, "num_iterations": 40}
    run(tmp_path, SOUND, FAILS_LATE, **options)
    again, _ = run(tmp_path, SOUND, FAILS_LATE, **options, resume=True)
    assert int(again.train_state.iteration) == 18 and checkpoint.healthy_step(tmp_path) == 6
