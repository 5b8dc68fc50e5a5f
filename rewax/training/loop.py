"""The loop around an agent: log, evaluate, keep, resume, stop cleanly."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
from rich.console import Console

from rewax.agents.base import Agent
from rewax.envs.base import Env
from rewax.training import checkpoint
from rewax.training.config import ReportConfig, TrainConfig
from rewax.training.interrupt import Stop, graceful_stop
from rewax.training.metrics import CsvWriter, TensorBoardWriter, read_csv
from rewax.training.progress import ProgressReport, say
from rewax.training.report import Evaluator
from rewax.types import Key

_EVALUATION_STREAM = 0x5EED  # folded into the seed, so that evaluation draws other numbers than training


class TrainResult(NamedTuple):
    """What a run came to.

    Attributes:
      train_state: the last one, also in the newest checkpoint.
      evaluation: row of the final evaluation (``sampled_mean``, ``deterministic_mean``, ...); empty if interrupted.
      signum: the signal that stopped the run early, 0 if it ran to its end.
    """

    train_state: Any
    evaluation: dict[str, Any]
    signum: int = 0


def train(
    agent: Agent,
    env: Env,
    config: TrainConfig,
    *,
    describe: Mapping[str, Any] | None = None,
    console: Console | None = None,
) -> TrainResult:
    """Train an agent and leave a run directory: checkpoints, metrics, evaluations, plots.

    A run resumed from a checkpoint continues as if it had never stopped, bit for bit on a CPU: the same final state and
    the same ``metrics.csv``. A checkpoint is on disk before anything that could fail is tried.

    Args:
      agent: algorithm bound to ``env``.
      env: unbatched environment to evaluate in.
      config: length, seed, place and reports of the run.
      describe: written into ``config.json`` beside ``config``; ``env`` and ``scale`` in it must not change on resuming.
      console: where to print; standard output by default.

    Raises:
      ValueError: ``run_dir`` holds a run already and ``resume`` is off, or cannot be resumed.
    """
    console = console or Console()
    run_dir = Path(config.run_dir).absolute()
    description = {**(describe or {}), "train": config}
    seed_key = jax.random.key(config.seed)
    train_state = _first_state(agent, config, run_dir, seed_key, description, console)
    checkpoint.write_config(run_dir, description)
    with graceful_stop(lambda text: say(console, text)) as stop:
        run = _Run(agent, env, config, run_dir, jax.random.fold_in(seed_key, _EVALUATION_STREAM), train_state, console)
        try:
            run.iterate(stop)
            return run.finish(stop)
        finally:
            run.close()


class _Run:
    """The open files of one run and its current training state."""

    def __init__(
        self, agent: Agent, env: Env, config: TrainConfig, run_dir: Path, key: Key, train_state: Any, console: Console
    ) -> None:
        self.agent, self.config, self.run_dir, self.console = agent, config, run_dir, console
        self.train_state = train_state
        resume_at = self.iteration
        self.metrics = CsvWriter(run_dir / "metrics.csv", resume_at=resume_at)
        self.timing = CsvWriter(run_dir / "timing.csv", resume_at=resume_at)
        self.board = TensorBoardWriter(run_dir / "tensorboard", resume_at=resume_at) if config.tensorboard else None
        self.evaluator = Evaluator(env, agent.policy, config, run_dir, key, resume_at=resume_at)

    @property
    def iteration(self) -> int:
        return int(self.train_state.iteration)

    @property
    def env_steps(self) -> int:
        return int(self.train_state.env_steps)

    def iterate(self, stop: Stop) -> None:
        """Train until the last iteration or until asked to stop; what was trained is kept whatever happens."""
        if self.iteration >= self.config.num_iterations:
            return
        train_step = compile_train_step(self.agent, self.train_state, self.console)
        progress = None
        try:
            if not stop.requested:
                self._evaluate_if_due()
            progress = ProgressReport(self.console, self.config.num_iterations, self.iteration)
            while self.iteration < self.config.num_iterations and not stop.requested:
                self._iteration(train_step, progress)
        finally:
            if progress is not None:
                progress.close()
            self.save()

    def _iteration(self, train_step: Any, progress: ProgressReport) -> None:
        before, began = self.env_steps, time.perf_counter()
        self.train_state, metrics = jax.block_until_ready(train_step(self.train_state))
        seconds = time.perf_counter() - began
        iteration, env_steps = self.iteration, self.env_steps
        metrics = jax.device_get(metrics)
        speed = (env_steps - before) / seconds
        if iteration % self.config.log_every == 0:
            times = {"seconds": round(seconds, 6), "steps_per_second": round(speed, 3)}
            self.metrics.write(iteration, {"env_steps": env_steps, **metrics})
            self.timing.write(iteration, times)
            if self.board is not None:
                self.board.write(iteration, metrics | times)
        progress.update(iteration, env_steps, metrics, speed)
        if self.config.checkpoint_every and iteration % self.config.checkpoint_every == 0:
            self.save()
        self._evaluate_if_due()

    def save(self) -> None:
        """Write a checkpoint of this iteration unless there is one."""
        if checkpoint.latest_step(self.run_dir) != self.iteration:
            checkpoint.save(self.run_dir, self.train_state, keep=self.config.keep_checkpoints)

    def _evaluate_if_due(self) -> None:
        if self.evaluator.is_due(self.iteration):
            self.save()
            self._evaluate()

    def _evaluate(self) -> dict[str, Any]:
        row = self.evaluator.evaluate(self.iteration, self.env_steps, self.train_state)
        if self.board is not None:
            self.board.write(self.iteration, row, prefix="eval")
        say(
            self.console,
            f"evaluation after {self.env_steps:,} steps: return {row['sampled_mean']:.4g} +- {row['sampled_std']:.2g} "
            f"sampled, {row['deterministic_mean']:.4g} +- {row['deterministic_std']:.2g} deterministic",
        )
        failed = int(row["sampled_failed"]) + int(row["deterministic_failed"])
        if failed:
            episodes = 2 * self.config.num_eval_episodes
            say(
                self.console,
                f"warning: {failed} of {episodes} episodes failed numerically and ended there: state.status says why; "
                "shorter substeps or softer contacts and materials help",
            )
        return row

    def finish(self, stop: Stop) -> TrainResult:
        """Final evaluation and plots; after an interruption plots only, and how to go on."""
        row: dict[str, Any] = {}
        baselines: dict[str, float] = {}
        if not stop.requested:
            row = self.evaluator.last if self.evaluator.last.get("env_steps") == self.env_steps else self._evaluate()
            if self.config.baselines:
                baselines = self.evaluator.baselines(self.train_state)
                say(self.console, "baselines: " + ", ".join(f"{name} {value:.4g}" for name, value in baselines.items()))
        if self.config.plots:
            for path in self.evaluator.draw(self.train_state, baselines):
                say(self.console, f"wrote {path}")
        if stop.requested:
            done = f"stopped after iteration {self.iteration} of {self.config.num_iterations}"
            rest = "continues from" if self.iteration < self.config.num_iterations else "does the final evaluation of"
            say(self.console, f"{done}: the same command with --resume {rest} {self.run_dir}")
        return TrainResult(self.train_state, row, stop.signum)

    def close(self) -> None:
        """Close every file."""
        for writer in (self.metrics, self.timing, self.board, self.evaluator):
            if writer is not None:
                writer.close()


def compile_train_step(agent: Agent, train_state: Any, console: Console) -> Any:
    """Compile ``agent.train_step`` ahead of the first iteration, telling the user how long it takes.

    Returns:
      The compiled function; it never traces again.
    """
    say(console, "compiling train_step ...")
    began = time.perf_counter()
    train_step = agent.train_step if hasattr(agent.train_step, "lower") else jax.jit(agent.train_step)
    compiled = train_step.lower(train_state).compile()  # type: ignore[union-attr]
    say(console, f"compiled in {time.perf_counter() - began:.1f} s")
    return compiled


def _first_state(
    agent: Agent, config: TrainConfig, run_dir: Path, key: Key, description: Mapping[str, Any], console: Console
) -> Any:
    """The training state to begin with: fresh, or from the newest checkpoint."""
    if not config.resume:
        if checkpoint.latest_step(run_dir) is not None or read_csv(run_dir / "metrics.csv"):
            raise ValueError(
                f"{run_dir} holds a run already: resume it (--resume) or choose another directory (--run-dir)"
            )
        return jax.jit(agent.init)(key)
    for name, old, new in _changes(checkpoint.read_config(run_dir), checkpoint.plain(description)):
        if name in ("env", "scale"):
            raise ValueError(f"{run_dir} holds a run with {name} {old}, not {new}: resume it with --{name} {old}")
        if name == "train.seed" or not name.startswith("train."):  # how to report is free to change
            say(console, f"note: resuming with {name} {new}, it was {old}")
    train_state = checkpoint.restore(run_dir, jax.eval_shape(agent.init, key))
    say(console, f"resuming {run_dir} after iteration {int(train_state.iteration)}")
    return train_state


def _changes(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any, Any]]:
    """Dotted names of entries that both have with other values, and the values."""
    changes = []
    for name in [name for name in new if name in old]:
        if isinstance(old[name], Mapping) and isinstance(new[name], Mapping):
            changes += _changes(old[name], new[name], f"{prefix}{name}.")
        elif old[name] != new[name]:
            changes.append((prefix + name, old[name], new[name]))
    return changes


__all__ = ["ReportConfig", "TrainConfig", "TrainResult", "compile_train_step", "train"]
