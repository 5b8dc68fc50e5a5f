"""A running training: its state, its open files, and what follows each iteration."""

import contextlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
from rich.console import Console

from rewax.agents.base import Agent
from rewax.envs.base import Env
from rewax.training.config import TrainConfig
from rewax.training.evaluation.programs import Programs
from rewax.training.evaluation.report import Evaluator
from rewax.training.loop.devices import on_one_device
from rewax.training.loop.failure import FailureWatch, FiniteCheck
from rewax.training.loop.hosts import Leader
from rewax.training.loop.interrupt import Stop
from rewax.training.loop.progress import ProgressReport, say
from rewax.training.storage import checkpoint
from rewax.training.storage.description import read_config
from rewax.training.storage.metrics import CsvWriter, TensorBoardWriter, WandbWriter, read_csv
from rewax.training.storage.schedule import Schedule, due_rows, lost_rows
from rewax.types import Key

RESUMED = "(rewax train with --resume, in Python TrainConfig(..., resume=True))"
"""How a command that is repeated continues a run; ``rewax bench`` and ``rewax tune`` do so by themselves."""
_REMEDY = "smaller learning rates or rewards, or a smaller max_env_grad_norm or max_grad_norm help"


class TrainResult(NamedTuple):
    """Result of a run.

    Attributes:
      train_state: the last one without non-finite numbers; the newest checkpoint has it too.
      evaluation: row of the final evaluation (``sampled_mean``, ``deterministic_mean``, ...); empty after an early
        stop.
      signum: the signal that stopped the run early; 0: none.
      failure: a sentence that says why the run failed; empty: it did not.
    """

    train_state: Any
    evaluation: dict[str, Any]
    signum: int = 0
    failure: str = ""


class Run:
    """The open files of one run and its current training state.

    Args:
      agent, env, config, console: as for ``train``.
      programs: compiled programs of evaluations and pictures.
      run_dir: existing directory of the run.
      key: draws the initial states of evaluations.
      train_state: initial state of this process.
      leader: sends commands to the other processes of this run.
    """

    def __init__(
        self,
        agent: Agent,
        env: Env,
        programs: Programs,
        config: TrainConfig,
        run_dir: Path,
        key: Key,
        train_state: Any,
        console: Console,
        leader: Leader,
    ) -> None:
        self.config, self.run_dir, self.console, self._leader = config, run_dir, console, leader
        self.train_state, self.failure = train_state, ""
        resume_at = self.iteration
        self.metrics = CsvWriter(run_dir / "metrics.csv", resume_at=resume_at)
        self.timing = CsvWriter(run_dir / "timing.csv", resume_at=resume_at)
        self.boards = _boards(config, run_dir, resume_at)
        self.evaluator = Evaluator(env, programs, config, run_dir, key, resume_at=resume_at)
        num_envs = getattr(agent.config, "num_envs", 0)
        self.watch, self.finite = FailureWatch(env, config, num_envs), FiniteCheck(train_state)
        self.watch.recall(read_csv(run_dir / "metrics.csv"), resume_at)
        self._healthy: int | None = checkpoint.healthy_step(run_dir)
        self._consumes, self._env_steps = agent.consumes, int(train_state.env_steps)
        self._progress: ProgressReport | None = None
        self._saved_at = time.perf_counter()

    @property
    def iteration(self) -> int:
        return int(self.train_state.iteration)

    @property
    def local_state(self) -> Any:
        """The training state on one device, for programs that are not sharded."""
        return on_one_device(self.train_state)

    @property
    def env_steps(self) -> int:
        return int(self.train_state.env_steps)

    def say(self, text: str) -> None:
        """Print a line, unless it is empty."""
        if text:
            say(self.console, text)

    def report_lost_rows(self, schedule: Schedule) -> None:
        """Print which rows are missing from the files of the resumed run."""
        due = due_rows(schedule, self.iteration)
        for name, writer in (
            ("metrics.csv", self.metrics),
            ("timing.csv", self.timing),
            ("eval.csv", self.evaluator.csv),
        ):
            self.say(lost_rows(name, writer.iterations, due[name]))

    def iterate(self, train_step: Any, stop: Stop) -> None:
        """Train until the last iteration, a signal or a failure. The last state is saved, after an exception too."""
        try:
            self.begin(stop)
            while not (self.over or stop.requested):
                began = time.perf_counter()
                self._leader.step()
                new, metrics = jax.block_until_ready(train_step(self.train_state))
                self.take(new, jax.device_get(metrics), time.perf_counter() - began)
        finally:
            self.end()

    @property
    def _last_iteration(self) -> int:
        return _last_iteration(self.config, self.iteration, self.env_steps)

    @property
    def over(self) -> bool:
        """The run has reached its end or has failed."""
        return bool(self.failure) or self.config.over(self.iteration, self.env_steps)

    def begin(self, stop: Stop) -> None:
        """Evaluate if it is due, and start the progress report; before the first iteration of this process."""
        if self.evaluator.is_due(self.iteration):
            self.save()
            stop.at_once = f"stopped before the first iteration: --resume continues {self.run_dir}"
            self._evaluate()
        elif self._consumes and self._healthy is None:
            self.save()  # a failing iteration goes back to it
        stop.at_once = ""
        self._progress = ProgressReport(self.console, self._last_iteration, self.iteration)

    def end(self) -> None:
        """Close the progress report and save; after the last iteration of this process."""
        try:
            if self._progress is not None:
                self._progress.close()
        finally:
            self.save()

    def take(self, new: Any, metrics: Mapping[str, Any], seconds: float) -> None:
        """Process an iteration: write its metrics, check for failure, save and evaluate where that is due.

        Args:
          new: the training state after the iteration.
          metrics: of the iteration.
          seconds: its duration.
        """
        before = self._env_steps
        iteration, env_steps = int(new.iteration), int(new.env_steps)
        speed = (env_steps - before) / seconds
        if iteration % self.config.log_every == 0:
            times = {"seconds": round(seconds, 6), "steps_per_second": round(speed, 3)}
            self.metrics.write(iteration, {"env_steps": env_steps, **metrics})
            self.timing.write(iteration, times)
            for board in self.boards:
                board.write(iteration, {**metrics, **times})
        if self._progress is not None:
            self._progress.total = _last_iteration(self.config, iteration, env_steps)
            self._progress.update(iteration, env_steps, metrics, speed)
        self.say(self.watch.add(iteration, env_steps - before, metrics))
        if bad := self.finite.first_bad(new):
            self.failure = f"iteration {iteration} made {bad} of the training state infinite or NaN: {_REMEDY}"
            if self._consumes:
                # Not sharded: placing arrays on devices of other processes would wait for these processes.
                self.train_state = checkpoint.restore(self.run_dir, jax.eval_shape(lambda state: state, new))
            else:
                self._leader.back()
            return
        self.train_state, self._env_steps = new, env_steps
        if not self.config.over(iteration, env_steps) and (reason := self.watch.reason()):
            self.failure = reason
            return
        due = self.config.checkpoint_every and iteration % self.config.checkpoint_every == 0
        if due and time.perf_counter() - self._saved_at >= self.config.checkpoint_seconds:
            self.save()
        if self.evaluator.is_due(iteration):
            self.save()
            self._evaluate()

    def save(self) -> None:
        """Write a checkpoint of this iteration unless there is one.

        The newest checkpoint from before the first failure is kept, however many follow it.
        """
        if any(leaf.is_deleted() for leaf in jax.tree.leaves(self.train_state) if isinstance(leaf, jax.Array)):
            return  # train_step consumed the state and was interrupted
        if self.iteration not in checkpoint.steps(self.run_dir):
            protect = None if self.watch.healthy else self._healthy
            whole = self._leader.gathered(self.train_state)
            checkpoint.save(self.run_dir, whole, keep=self.config.keep_checkpoints, protect=protect)
        self._saved_at = time.perf_counter()
        if self.watch.healthy:
            self._healthy = self.iteration
        checkpoint.write_healthy(self.run_dir, self._healthy)

    def _evaluate(self) -> dict[str, Any]:
        row = self.evaluator.evaluate(self.iteration, self.env_steps, self.local_state)
        for board in self.boards:
            board.write(self.iteration, row, prefix="eval")
        for sentence in self.evaluator.sentences(row):
            self.say(sentence)
        return row

    def finish(self, stop: Stop) -> TrainResult:
        """Evaluate and draw; after an early stop only draw, and print how to continue."""
        row: dict[str, Any] = {}
        baselines: dict[str, float] = {}
        stopped = stop.requested or bool(self.failure)
        if not stopped:
            self.failure = self.watch.reason(final=True)
            row = self.evaluator.last if self.evaluator.last.get("env_steps") == self.env_steps else self._evaluate()
            if self.config.baselines:
                baselines = self.evaluator.baselines(self.local_state)
                self.say("baselines: " + ", ".join(f"{name} {value:.4g}" for name, value in baselines.items()))
        if self.config.plots:
            for sentence in self.evaluator.draw(self.local_state, baselines):
                self.say(sentence)
        if self.failure:
            self.say(self._how_it_failed())
        elif stopped:
            done = f"stopped after iteration {self.iteration} of {self._last_iteration}"
            ended = self.config.over(self.iteration, self.env_steps)
            rest = "does the final evaluation of" if ended else "continues from"
            self.say(f"{done}: the same command {rest} {self.run_dir} {RESUMED}")
        return TrainResult(self.train_state, row, stop.signum, self.failure)

    def _how_it_failed(self) -> str:
        done = f"failed after iteration {self.iteration} of {self._last_iteration}: {self.failure}"
        if self._healthy is None or self._healthy == self.iteration:
            return f"{done}; the last checkpoint is that of iteration {self.iteration}"
        return f"{done}; the last checkpoint from before the failures is that of iteration {self._healthy}"

    def close(self) -> None:
        """Close every file."""
        with contextlib.ExitStack() as stack:  # an error of one closes the others nevertheless
            for writer in (self.metrics, self.timing, *self.boards, self.evaluator):
                stack.callback(writer.close)


def _last_iteration(config: TrainConfig, iteration: int, env_steps: int) -> int:
    """The last iteration of the run; estimated from the mean number of steps if it ends after ``num_steps``."""
    if not config.num_steps or not env_steps:
        return config.num_iterations
    return max(iteration, -(-iteration * config.num_steps // env_steps))


def _boards(config: TrainConfig, run_dir: Path, resume_at: int) -> list[TensorBoardWriter | WandbWriter]:
    """Writers of metrics besides the CSV files."""
    found: list[TensorBoardWriter | WandbWriter] = []
    if config.tensorboard:
        found.append(TensorBoardWriter(run_dir / "tensorboard", resume_at=resume_at))
    if config.wandb:
        found.append(WandbWriter(config.wandb, run_dir, read_config(run_dir)))
    return found
