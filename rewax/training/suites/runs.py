"""Runs of a suite, one after the other: skips what is done, resumes what was interrupted, keeps one table.

``results.csv`` and ``curves.csv`` say all that the table and the pictures need. A directory that holds these two alone,
from another machine for example, is continued like any other.
"""

import dataclasses
import functools
import itertools
import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from rewax.agents.config import steps_in
from rewax.agents.registry import build_agent
from rewax.envs.base import Env
from rewax.training.config import TrainConfig
from rewax.training.evaluation.episodes import constant_policy, make_evaluate, uniform_policy
from rewax.training.loop.compilation import programs_kept
from rewax.training.loop.progress import say
from rewax.training.loop.train import train
from rewax.training.storage import checkpoint
from rewax.training.storage.description import plain, provenance, read_config
from rewax.training.storage.metrics import read_csv
from rewax.training.storage.run_directory import CannotWrite, InUse, hold
from rewax.training.suites.suite import Suite
from rewax.training.suites.tables import COLUMNS, LATER, check_readable, read_results, write_results
from rewax.whole_files import replacing

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
    """All runs in the order of the table."""
    for seed in suite.seeds:
        for task in suite.tasks:
            for name in suite.algorithms:
                yield Cell(task, name, seed)


def in_turn(suite: Suite) -> list[Cell]:
    """All runs in the order in which they are done: the first seed of everything, then the others of each algorithm on
    each task, which share their compiled programs."""
    first, *others = suite.seeds
    pairs = [(task, name) for task in suite.tasks for name in suite.algorithms]
    return [Cell(*pair, first) for pair in pairs] + [Cell(*pair, seed) for pair in pairs for seed in others]


def run_suite(
    suite: Suite,
    out_dir: str | Path,
    console: Console,
    *,
    part: Suite | None = None,
    devices: int = 0,
    imports: Sequence[Mapping[str, str]] = (),
) -> int:
    """Do all runs that are not done yet, and write ``results.csv``, ``table.md`` and learning curves after each.

    A run that fails or raises an exception is recorded as failed, and the next one begins. A run is done if its
    directory has a ``result.json``, or ``results.csv`` a row. A run of another process is skipped.

    Args:
      suite: its results are written.
      out_dir: holds the results, and the run directories in ``runs/<task>/<algorithm>/<seed>``. Those of finished runs
        may be removed.
      console: to print to.
      part: the runs to do; by default the whole suite.
      devices: number of devices that environments are sharded over, see ``TrainConfig``.
      imports: the modules that register environments or algorithms, as ``import_modules`` returns them.

    Returns:
      The signal that stopped it, 0 if all runs are done.

    Raises:
      ValueError: the suite has a wrong entry, or ``out_dir`` cannot be used, or holds results of other options or
        that cannot be read.
    """
    out_dir, part = Path(out_dir), suite if part is None else part
    for task, algorithm in itertools.product(suite.tasks, suite.algorithms):
        suite.config(task, algorithm)  # a wrong entry is refused before the first run
    _claim(suite, out_dir)
    check_readable(out_dir)
    for task in part.tasks:
        _baselines(suite, task, out_dir)
    everything, known = in_turn(part), read_results(out_dir)
    env_of = functools.lru_cache(maxsize=1)(suite.env)
    with programs_kept():
        for number, cell in enumerate(everything, start=1):
            if read_result(cell.folder(out_dir)) or cell in known:
                continue
            say(console, f"run {number} of {len(everything)}: {cell.algorithm} on {cell.task}, seed {cell.seed}")
            try:
                signum = _run(suite, cell, env_of(cell.task), out_dir, console, devices, imports)
            except InUse:  # benchmarks side by side
                say(console, "another process does this run: skipped")
                continue
            if signum:
                say(console, f"stopped: the same command continues {out_dir}")
                return signum
            write_results(suite, rows(suite, out_dir), out_dir, pictures=(cell.task,))
    for sentence in write_results(suite, rows(suite, out_dir), out_dir):
        say(console, sentence)
    return 0


def any_failed(suite: Suite, part: Suite, out_dir: str | Path) -> bool:
    """Whether a run of a part of the suite has failed."""
    chosen = set(in_turn(part))
    found = rows(suite, Path(out_dir))
    return any(not math.isfinite(r["sampled"]) and (r["task"], r["algorithm"], r.get("seed")) in chosen for r in found)


def _claim(suite: Suite, out_dir: Path) -> None:
    """Write the suite's options to ``suite.json``, or compare with it: results of other options need another table."""
    path, names = out_dir / "suite.json", ("scale", "steps", "options", "env_options", "num_eval_episodes")
    options = plain({name: getattr(suite, name) for name in names})
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        stored = {"env_options": {}, **dict(json.loads(path.read_text()))} if path.is_file() else options
        if not path.is_file():
            with replacing(path) as unfinished:
                unfinished.write_text(json.dumps(options, indent=1) + "\n")
    except (OSError, ValueError, TypeError) as error:  # of the disk, of json and of dict
        raise ValueError(f"{out_dir} cannot hold results ({error}): choose another directory (--out)") from None
    if stored != options:
        odd = next(name for name in {**options, **stored} if stored.get(name) != options.get(name))
        raise ValueError(f"{out_dir} holds results with other {odd}: choose another directory (--out)")


def rows(suite: Suite, out_dir: Path) -> list[dict[str, Any]]:
    """Rows so far: one per baseline, and one per finished run."""
    found = []
    for task in suite.tasks:
        for name, mean in _known_baselines(out_dir, task).items():
            found.append({"task": task, "algorithm": name, "seed": 0, "sampled": mean, "deterministic": mean})
    return found + list(results(suite, out_dir).values())


def results(suite: Suite, out_dir: Path) -> dict[Cell, dict[str, Any]]:
    """Rows of finished runs, from their directories, or from ``results.csv`` if a directory was removed."""
    kept = read_results(out_dir)
    found = {cell: read_result(cell.folder(out_dir)) or kept.get(cell, {}) for cell in cells(suite)}
    return {cell: row for cell, row in found.items() if row}


def read_result(folder: Path) -> dict[str, Any]:
    """The row of a finished run; empty if it is not finished."""
    try:
        result = json.loads((folder / "result.json").read_text())
    except (OSError, ValueError):
        return {}
    needed = set(COLUMNS) - set(LATER)
    whole = isinstance(result, dict) and needed <= set(result) and isinstance(result["sampled"], float)
    return result if whole else {}


def _run(
    suite: Suite,
    cell: Cell,
    env: Env,
    out_dir: Path,
    console: Console,
    devices: int,
    imports: Sequence[Mapping[str, str]],
) -> int:
    """Do one run, from its newest checkpoint if it has one; returns the signal that stopped it."""
    folder = cell.folder(out_dir)
    config = suite.config(cell.task, cell.algorithm)
    per_iteration = config.num_envs * steps_in(config, env)
    if cell.task in suite.steps:
        config = dataclasses.replace(config, num_iterations=math.ceil(suite.steps[cell.task] / per_iteration))
    agent = build_agent(cell.algorithm, env, config)
    options = TrainConfig(
        num_iterations=config.num_iterations,
        num_steps=config.num_iterations * per_iteration,
        run_dir=str(folder),
        seed=cell.seed,
        devices=devices,
        resume=checkpoint.latest_step(folder) is not None,
        num_eval_episodes=suite.num_eval_episodes,
        eval_every=0,
        # A replay buffer is large, and every checkpoint holds it.
        checkpoint_every=max(10, config.num_iterations // 10) if agent.consumes else 1,
        checkpoint_seconds=30.0,
        keep_checkpoints=1 if agent.consumes else 3,
        baselines=False,
        plots=False,
        tensorboard=False,
        max_failed_share=1.0,
    )
    if not options.resume:
        with hold(folder):  # of a run that stopped before its first checkpoint
            (folder / "metrics.csv").unlink(missing_ok=True)
    describe = {
        "env": cell.task,
        "scale": suite.scale,
        "seed": cell.seed,
        "agent": cell.algorithm,
        cell.algorithm: config,
    } | ({"imports": list(imports)} if imports else {})
    row: dict[str, Any] = {
        **dict.fromkeys(COLUMNS, 0),
        **cell._asdict(),
        **provenance(),
        "sampled": math.nan,
        "deterministic": math.nan,
        "success": math.nan,
    }
    began = time.perf_counter()
    try:
        result = train(agent, env, options, describe=describe, console=console)
    except (ValueError, CannotWrite):  # of the directory, the configuration or the disk: not this run's failure
        raise
    except Exception as error:  # out of memory, for example: the other runs may do better
        row["failure"] = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        say(console, f"failed: {row['failure']}")
    else:
        if result.signum:
            return result.signum
        row |= _provenance_of(folder) | {
            "env_steps": int(result.train_state.env_steps),
            "sampled": float(result.evaluation.get("sampled_mean", math.nan)),
            "deterministic": float(result.evaluation.get("deterministic_mean", math.nan)),
            "success": float(result.evaluation.get("sampled_success", math.nan)),
            "failed": int(result.evaluation.get("sampled_failed", 0)),
            "failure": result.failure,
        }
    seconds = read_csv(folder / "timing.csv").get("seconds", np.zeros(0))
    # The median, because compilation, interruptions and other processes lengthen a few iterations.
    row["seconds"] = round(len(seconds) * float(np.median(seconds)), 3) if len(seconds) else 0.0
    # The clock covers only the last part of a resumed run, so the time of all iterations is a lower bound.
    row["wall_seconds"] = round(max(time.perf_counter() - began, row["seconds"]), 1)
    with replacing(folder / "result.json") as unfinished:
        unfinished.write_text(json.dumps(row, indent=1) + "\n")
    return 0


def _provenance_of(folder: Path) -> dict[str, str]:
    """Commit, processor, C++ and JAX of a run; those of all parts if it was resumed with others."""
    parts, now = read_config(folder).get("provenance", []), provenance()
    return {name: " then ".join(dict.fromkeys(p.get(name, "") for p in parts)) or now[name] for name in now}


def _known_baselines(out_dir: Path, task: str) -> dict[str, float]:
    """Baselines from ``baselines.json`` or from ``results.csv``; empty if one is missing."""
    try:
        stored = json.loads(_baselines_path(out_dir, task).read_text())
        return {name: float(stored[name]) for name in BASELINES}
    except (OSError, ValueError, KeyError, TypeError):
        kept = read_results(out_dir)
        found = {name: kept[task, name, 0]["sampled"] for name in BASELINES if (task, name, 0) in kept}
        return found if len(found) == len(BASELINES) else {}


def _baselines_path(out_dir: Path, task: str) -> Path:
    return out_dir / "runs" / task / "baselines.json"


def _baselines(suite: Suite, task: str, out_dir: Path) -> None:
    """Compute the mean returns of zero actions and of random actions, unless they are stored."""
    if _known_baselines(out_dir, task):
        return
    env = suite.env(task)
    policies = (constant_policy(jnp.zeros(env.action_spec.shape)), uniform_policy(env))
    returns = {
        name: float(_mean_return(env, policy, suite.num_eval_episodes))
        for name, policy in zip(BASELINES, policies, strict=True)
    }
    with replacing(_baselines_path(out_dir, task)) as unfinished:
        unfinished.write_text(json.dumps(returns, indent=1) + "\n")


def _mean_return(env: Any, policy: Any, num_episodes: int) -> Any:
    evaluate = make_evaluate(env, policy, num_episodes)
    return evaluate(None, jax.random.key(_EVALUATION_KEY))["mean"]
