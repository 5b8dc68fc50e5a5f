"""Evaluations and pictures of a run, and their files."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

from rewax.envs.base import Env
from rewax.status import Status
from rewax.training.config import ReportConfig
from rewax.training.evaluation.pictures import attempt, draw_page, draw_strip, draw_video, reason
from rewax.training.evaluation.programs import MODES, Programs
from rewax.training.evaluation.recording import can_record
from rewax.training.storage.leaves import to_numpy
from rewax.training.storage.metrics import CsvWriter, read_csv
from rewax.types import Key
from rewax.whole_files import replacing

_STATISTICS = ("mean", "std", "min", "max", "failed", *(f"status/{bit.name}" for bit in Status if bit))


class Evaluator:
    """Evaluates a policy with sampled and with deterministic actions from fixed initial states; writes ``eval.csv``.

    Args:
      env: unbatched environment.
      programs: compiled evaluations and recordings of the environment and the agent's policy.
      config: options of the run.
      run_dir: directory of the run.
      key: draws initial states.
      resume_at: iteration that the run continues from.
    """

    def __init__(
        self, env: Env, programs: Programs, config: ReportConfig, run_dir: Path, key: Key, *, resume_at: int
    ) -> None:
        self._env, self._programs, self._config, self._run_dir, self._key = env, programs, config, run_dir, key
        self.csv = CsvWriter(run_dir / "eval.csv", resume_at=resume_at)
        self.last: dict[str, Any] = {}

    def is_due(self, iteration: int) -> bool:
        """Whether an evaluation is scheduled after this iteration and missing from ``eval.csv``."""
        every = self._config.eval_every
        if iteration == 0 and not self._config.eval_at_start:
            return False
        return every > 0 and iteration % every == 0 and self.csv.last_iteration < iteration

    def evaluate(self, iteration: int, env_steps: int, train_state: Any) -> dict[str, Any]:
        """Evaluate and append a row: ``sampled_mean``, ..., ``sampled_failed``, ``sampled_status/NAN``, ..., and the
        same for ``deterministic``. Counts are numbers of episodes.
        """
        row: dict[str, Any] = {"env_steps": env_steps}
        for name in ("sampled", "deterministic"):
            result = jax.device_get(self._programs.evaluate(train_state, name, self._key))
            row |= {f"{name}_{statistic}": result[statistic] for statistic in _STATISTICS}
            if "success" in result:
                row[f"{name}_success"] = result["success"]
        if self.csv.last_iteration < iteration:
            self.csv.write(iteration, row)
        self.last = row
        return row

    def baselines(self, train_state: Any) -> dict[str, float]:
        """Mean returns of zero actions and of random actions from the same initial states, kept in ``baselines.json``.

        Both use the program that was compiled for ``evaluate``, so they need a training state. The name of a baseline
        tells how many of its episodes failed. A resumed run with another number of episodes, or with an environment of
        other parameters, measures them anew.
        """
        path, of = self._run_dir / "baselines.json", self._measured_on()
        try:
            stored = json.loads(path.read_text())
            if stored.pop("of") == of:
                return {str(name): float(value) for name, value in stored.items()}
        except (OSError, ValueError, TypeError, AttributeError, KeyError):  # missing or damaged
            pass
        returns = {}
        for name in MODES[2:]:
            result = self._programs.evaluate(train_state, name, self._key)
            count = _failed_of(int(result["failed"]), self._config.num_eval_episodes)
            returns[name + count] = float(result["mean"])
        with replacing(path) as unfinished:
            unfinished.write_text(json.dumps({**returns, "of": of}, indent=2) + "\n")
        return returns

    def _measured_on(self) -> dict[str, Any]:
        """What the returns of baselines depend on: episodes, and the environment's arrays."""
        arrays = hashlib.sha256()
        for leaf in jax.tree.leaves(self._env):
            arrays.update(to_numpy(leaf).tobytes())
        return {"episodes": self._config.num_eval_episodes, "environment": arrays.hexdigest()[:16]}

    def sentences(self, row: Mapping[str, Any]) -> list[str]:
        """An evaluation in sentences: returns, number of failed episodes, status bits."""
        episodes = self._config.num_eval_episodes
        failed = {mode: int(row[f"{mode}_failed"]) for mode in MODES[:2]}
        returns = [
            f"{row[f'{mode}_mean']:.4g} +- {row[f'{mode}_std']:.2g} {mode}{_failed_of(count, episodes)}"
            for mode, count in failed.items()
        ]
        sentences = [f"evaluation after {row['env_steps']:,} steps: return {', '.join(returns)}"]
        if total := sum(failed.values()):
            sentences.append(
                f"warning: {total} of {2 * episodes} episodes failed numerically and ended early; their returns count "
                "only the steps before the failure. Shorter substeps or softer contacts and materials help"
            )
        bits = {bit.name: sum(int(row[f"{mode}_status/{bit.name}"]) for mode in MODES[:2]) for bit in Status if bit}
        if any(bits.values()):
            counts = ", ".join(f"{name} in {count}" for name, count in bits.items() if count)
            sentences.append(f"status of {2 * episodes} episodes: {counts} (rewax.status.Status explains each)")
        return sentences

    def draw(self, train_state: Any, baselines: Mapping[str, float]) -> list[str]:
        """Draw the learning curve and, if the environment has ``particles`` or ``render_shapes``, a deterministic
        episode: ``episode.png``, and with ``config.video`` also ``episode.mp4`` and ``episode.html``.

        Returns:
          A sentence about each file: its path, or why it was not drawn. No exception is raised.
        """
        env: Any = getattr(self._env, "unwrapped", self._env)
        sentences = [attempt(self._run_dir / "learning_curve.png", lambda path: self._draw_curve(path, baselines))]
        if not can_record(env):
            return sentences
        try:
            recording = self._programs.record(train_state, self._key, self._run_dir.resolve().name)
        except Exception as error:  # the environment's code is called
            return [*sentences, f"warning: episode.png was not drawn ({reason(error)}); nothing else is affected"]
        frames = self._config.num_frames
        files = {"episode.png": lambda path: draw_strip(recording, path, num_frames=frames)}
        if self._config.video:
            files |= {
                "episode.html": lambda path: draw_page(recording, path),
                "episode.mp4": lambda path: draw_video(recording, path),
            }
        return sentences + [attempt(self._run_dir / name, draw) for name, draw in files.items()]

    def _draw_curve(self, path: Path, baselines: Mapping[str, float]) -> str:
        from rewax.viz import plots  # matplotlib is slow to import

        metrics, evaluation = read_csv(self._run_dir / "metrics.csv"), read_csv(self._run_dir / "eval.csv")
        plots.learning_curve(metrics, path, evaluation=evaluation, baselines=baselines)
        return ""

    def close(self) -> None:
        """Close ``eval.csv``."""
        self.csv.close()


def _failed_of(failed: int, episodes: int) -> str:
    return f" ({failed} of {episodes} episodes failed)" if failed else ""
