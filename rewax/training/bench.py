"""Runs of a suite, one after the other: skips what is done, resumes what was interrupted, keeps one table."""

import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from rewax.agents.registry import algorithm
from rewax.envs.registry import make
from rewax.training import checkpoint
from rewax.training.config import TrainConfig
from rewax.training.evaluate import constant_policy, make_evaluate, uniform_policy
from rewax.training.loop import train
from rewax.training.metrics import read_csv
from rewax.training.progress import say
from rewax.training.suite import Suite
from rewax.training.tables import write_results

_EVALUATION_KEY = 1234
BASELINES = ("no action", "random actions")


class Cell(NamedTuple):
    """One run of a suite."""

    task: str
    algorithm: str
    seed: int

    def folder(self, out_dir: Path) -> Path:
        """Its run directory."""
        return out_dir / "runs" / self.task / self.algorithm / str(self.seed)


def cells(suite: Suite) -> Iterator[Cell]:
    """All runs, in the order in which they are done: the first seed of everything comes first."""
    for seed in suite.seeds:
        for task in suite.tasks:
            for name in suite.algorithms:
                yield Cell(task, name, seed)


def run_suite(suite: Suite, out_dir: str | Path, console: Console) -> int:
    """Do all runs that are not done yet, and write ``results.csv``, ``table.md`` and learning curves after each.

    A run that fails is written down as such, and the next one is done.

    Args:
      suite: what to run.
      out_dir: holds the results, and the run directories in ``runs/<task>/<algorithm>/<seed>``.
      console: where to print.

    Returns:
      The signal that stopped it, 0 if all runs are done.
    """
    out_dir = Path(out_dir)
    everything = list(cells(suite))
    for cell in everything:  # a suite that cannot be is refused before the first run
        suite.config(cell.task, cell.algorithm)
    for task in suite.tasks:
        _baselines(suite, task, out_dir)
    for number, cell in enumerate(everything, start=1):
        if read_result(cell.folder(out_dir)):
            continue
        say(console, f"run {number} of {len(everything)}: {cell.algorithm} on {cell.task}, seed {cell.seed}")
        if signum := _run(suite, cell, out_dir, console):
            say(console, f"stopped: the same command continues {out_dir}")
            return signum
        write_results(suite, rows(suite, out_dir), out_dir)
    for sentence in write_results(suite, rows(suite, out_dir), out_dir):
        say(console, sentence)
    return 0


def rows(suite: Suite, out_dir: Path) -> list[dict[str, Any]]:
    """What is known so far: one row per finished run, and one per baseline."""
    found = []
    for task in suite.tasks:
        for name, mean in _baselines(suite, task, out_dir).items():
            found.append({"task": task, "algorithm": name, "seed": 0, "sampled": mean, "deterministic": mean})
    return found + [result for cell in cells(suite) if (result := read_result(cell.folder(out_dir)))]


def read_result(folder: Path) -> dict[str, Any]:
    """The row of a run that is done; empty if it is not."""
    try:
        result = json.loads((folder / "result.json").read_text())
    except (OSError, ValueError):
        return {}
    return result if isinstance(result, dict) else {}


def _run(suite: Suite, cell: Cell, out_dir: Path, console: Console) -> int:
    """One run, from its newest checkpoint if it has one; the signal that stopped it."""
    folder, known, env = cell.folder(out_dir), algorithm(cell.algorithm), make(cell.task, scale=suite.scale)
    config = suite.config(cell.task, cell.algorithm)
    if cell.task in suite.steps:
        per_iteration = config.num_envs * config.steps_in(env)
        config = dataclasses.replace(config, num_iterations=math.ceil(suite.steps[cell.task] / per_iteration))
    options = TrainConfig(
        num_iterations=config.num_iterations,
        run_dir=str(folder),
        seed=cell.seed,
        resume=checkpoint.latest_step(folder) is not None,
        num_eval_episodes=suite.num_eval_episodes,
        eval_every=0,
        baselines=False,
        plots=False,
        tensorboard=False,
        max_failed_share=1.0,
    )
    if not options.resume:
        (folder / "metrics.csv").unlink(missing_ok=True)  # of a run that stopped before its first checkpoint
    describe = {
        "env": cell.task,
        "scale": suite.scale,
        "seed": cell.seed,
        "agent": cell.algorithm,
        cell.algorithm: config,
    }
    result = train(known.make(env, config), env, options, describe=describe, console=console)
    if result.signum:
        return result.signum
    row = {
        **cell._asdict(),
        "env_steps": int(result.train_state.env_steps),
        "sampled": float(result.evaluation.get("sampled_mean", math.nan)),
        "deterministic": float(result.evaluation.get("deterministic_mean", math.nan)),
        "failed": int(result.evaluation.get("sampled_failed", 0)),
        "seconds": round(float(np.sum(read_csv(folder / "timing.csv").get("seconds", 0.0))), 3),
        "failure": result.failure,
    }
    unfinished = folder / "result.json.writing"
    unfinished.write_text(json.dumps(row, indent=1) + "\n")
    unfinished.replace(folder / "result.json")
    return 0


def _baselines(suite: Suite, task: str, out_dir: Path) -> dict[str, float]:
    """Mean returns of doing nothing and of random actions, from initial states of their own; computed once."""
    path = out_dir / "runs" / task / "baselines.json"
    try:
        return {name: float(json.loads(path.read_text())[name]) for name in BASELINES}
    except (OSError, ValueError, KeyError, TypeError):
        pass
    env = make(task, scale=suite.scale)
    policies = (constant_policy(jnp.zeros(env.action_spec.shape)), uniform_policy(env))
    returns = {
        name: float(_mean_return(env, policy, suite.num_eval_episodes))
        for name, policy in zip(BASELINES, policies, strict=True)
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(returns, indent=1) + "\n")
    return returns


def _mean_return(env: Any, policy: Any, num_episodes: int) -> Any:
    evaluate = make_evaluate(env, policy, num_episodes)
    return evaluate(None, jax.random.key(_EVALUATION_KEY))["mean"]
