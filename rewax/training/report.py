"""Evaluations and pictures of a run, and the files that hold them."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from rewax.envs.base import Env
from rewax.training.config import ReportConfig
from rewax.training.evaluate import Frame, Policy, make_evaluate, record_episode, uniform_policy
from rewax.training.metrics import CsvWriter, read_csv
from rewax.types import Key

_STATISTICS = ("mean", "std", "min", "max", "failed")


class Evaluator:
    """Evaluates a policy, sampled and deterministic, always from the same initial states; appends to ``eval.csv``.

    Args:
      env: unbatched environment.
      policy: as of ``Agent.policy``.
      config: of the run.
      run_dir: directory of the run.
      key: draws initial states.
      resume_at: iteration that the run continues from.
    """

    def __init__(
        self, env: Env, policy: Policy, config: ReportConfig, run_dir: Path, key: Key, *, resume_at: int
    ) -> None:
        self._env, self._policy, self._config, self._run_dir, self._key = env, policy, config, run_dir, key
        self._evaluate = make_evaluate(env, _any_of(env, policy), config.num_eval_episodes)
        self._csv = CsvWriter(run_dir / "eval.csv", resume_at=resume_at)
        self.last: dict[str, Any] = {}

    def is_due(self, iteration: int) -> bool:
        """The schedule asks for an evaluation here, and ``eval.csv`` does not have it yet."""
        every = self._config.eval_every
        return every > 0 and iteration % every == 0 and self._csv.last_iteration < iteration

    def evaluate(self, iteration: int, env_steps: int, train_state: Any) -> dict[str, Any]:
        """Evaluate and append a row: ``sampled_mean``, ..., ``deterministic_failed``."""
        row: dict[str, Any] = {"env_steps": env_steps}
        for name in ("sampled", "deterministic"):
            result = jax.device_get(self._evaluate((train_state, _MODES.index(name)), self._key))
            row |= {f"{name}_{statistic}": result[statistic] for statistic in _STATISTICS}
        if self._csv.last_iteration < iteration:
            self._csv.write(iteration, row)
        self.last = row
        return row

    def baselines(self, train_state: Any) -> dict[str, float]:
        """Mean returns of no action and of random actions from the same initial states, kept in ``baselines.json``.

        The training state is not used, but the program that was compiled for ``evaluate`` is.
        """
        path = self._run_dir / "baselines.json"
        if path.is_file():
            return json.loads(path.read_text())
        result = {
            name: float(self._evaluate((train_state, _MODES.index(name)), self._key)["mean"]) for name in _MODES[2:]
        }
        path.write_text(json.dumps(result, indent=2) + "\n")
        return result

    def draw(self, train_state: Any, baselines: Mapping[str, float]) -> list[Path]:
        """Draw the learning curve and, where the environment offers ``particles`` or ``render_shapes``, one
        deterministic episode."""
        from rewax.viz import plots  # matplotlib is slow to import

        metrics, evaluation = read_csv(self._run_dir / "metrics.csv"), read_csv(self._run_dir / "eval.csv")
        curve = self._run_dir / "learning_curve.png"
        written = [plots.learning_curve(metrics, curve, evaluation=evaluation, baselines=baselines)]
        env: Any = getattr(self._env, "unwrapped", self._env)
        if hasattr(env, "particles") or hasattr(env, "render_shapes"):
            frames = record_episode(env, self._policy, train_state, self._key, num_frames=self._config.num_frames)
            written.append(_draw_episode(env, frames, self._run_dir / "episode.png"))
        return written

    def close(self) -> None:
        """Close ``eval.csv``."""
        self._csv.close()


_MODES = ("sampled", "deterministic", "no action", "random actions")


def _draw_episode(env: Any, frames: Sequence[Frame], out_png: Path) -> Path:
    """Particles with what moves among them, or rigid bodies alone, up to the episode's end."""
    from rewax.viz import bodies, plots

    frames = [frame for i, frame in enumerate(frames) if i == 0 or frame.step > frames[i - 1].step]
    labels = [f"step {f.step}\nreturn {f.total:{'.0f' if abs(f.total) >= 100 else '.3g'}}" for f in frames]
    shapes = [env.render_shapes(frame.physics) if hasattr(env, "render_shapes") else [] for frame in frames]
    if hasattr(env, "particles"):
        clouds = [env.particles(frame.physics) for frame in frames]
        return plots.particle_strip(clouds, out_png, labels=labels, shapes=shapes)
    return bodies.body_strip(shapes, out_png, labels=labels, up=getattr(env, "up", (0.0, 1.0, 0.0)))


def _any_of(env: Env, policy: Policy) -> Policy:
    """A policy of ``(train_state, mode)``: one program, compiled once, for the agent's policies and the baselines."""
    random = uniform_policy(env)

    def choose(state_and_mode: Any, obs: Any, key: Key, deterministic: bool = False) -> jax.Array:
        train_state, mode = state_and_mode
        shape, dtype = env.action_spec.shape, jnp.result_type(float)
        branches = (
            lambda: policy(train_state, obs, key, deterministic=False).astype(dtype),
            lambda: policy(train_state, obs, key, deterministic=True).astype(dtype),
            lambda: jnp.zeros(shape, dtype),
            lambda: random(None, obs, key).astype(dtype),
        )
        return jax.lax.switch(mode, branches)

    return choose
