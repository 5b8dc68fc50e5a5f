"""The loop of ``rewax.identify``: from a push to a dough to a policy, and what the policy earns in the true scene.

    python benchmarks/identify_loop.py                                 # what has no row yet: an hour on one core
    python benchmarks/identify_loop.py --tasks RollingFlat --seeds 0
    python benchmarks/identify_loop.py --table                         # the tables of the rows that are there

The true dough is far from the median of the priors. A script moves the tool once, and a camera with 2 mm of noise looks
on; 30 % of the body are hidden, and its particles lie elsewhere than those of the fit. ``identify`` finds the dough.
Then SAPO trains a policy for each cell (column, seed) and 64 episodes of the true scene evaluate it, with deterministic
actions and from the same starts. Columns say what a policy trains on:

    truth         the true dough
    identified    doughs drawn at every reset from what identify found (``rewax train --env-from``)
    prior         doughs drawn at every reset from the priors

The results of the fits lie beside the rows, as files of ``rewax identify``.
"""

import dataclasses
import functools
import itertools
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from rows import fill, mean, read
from trained import earned

import rewax
from rewax.agents.presets import sapo_preset
from rewax.agents.sapo import make_sapo
from rewax.envs.randomize import LogUniform, hook, identified
from rewax.identify import identify, record
from rewax.identify.starts import placements_of
from rewax.identify.surface import particle_spacing
from rewax.training import enable_compilation_cache

_MODULUS, _YIELD = "scene.material.elasticity.youngs_modulus", "scene.material.plasticity.yield_stress"
PRIORS = {_MODULUS: LogUniform(200.0, 2000.0), _YIELD: LogUniform(4.0, 80.0)}
TRUTH = {_MODULUS: 1600.0, _YIELD: 6.0}
COLUMNS = ("truth", "identified", "prior")
EPISODES, NOISE = 64, 0.002
OUT = Path(__file__).resolve().parent.parent / "docs/suites/identify"
FIELDS = (
    "task", "column", "seed", "return", "std", "seconds", "env_steps", "iterations", "commit", "processor",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Task:
    """A task at scale ``small``.

    Attributes:
      substeps: of a control step, with which the stiffest dough of the priors is stable.
      push: stretches of constant actions: their number and the action; a number stands for all joints.
    """

    substeps: int
    push: tuple[tuple[int, Any], ...]


TASKS = {
    "RollingFlat": Task(substeps=16, push=((12, (0.3, -1.0, 0.0)), (4, (0.3, 1.0, 0.0)))),
    "HandFlip": Task(substeps=20, push=((16, 0.5),)),
}


def env_of(name: str, numbers: dict[str, float] | None = None) -> Any:
    """The task, with a dough."""
    env: Any = rewax.make(name, scale="small", num_substeps=TASKS[name].substeps)
    for path, value in (numbers or {}).items():
        env = rewax.replace_leaf(env, path, value)
    return env


def fit(name: str, out: Path) -> Path:
    """The file of what ``identify`` found from one push; it is made if there is none."""
    path = out / f"loop_{name}.json"
    if path.is_file():
        return path
    env, real = env_of(name), env_of(name, TRUTH)
    spacing = particle_spacing(np.asarray(env.rest_positions))
    placed = placements_of(env, 1, 0.4, spacing, seed=1000)[0].astype(np.float32)  # other places than the fit's
    push = np.concatenate(
        [np.broadcast_to(np.float32(action), (count, *env.action_spec.shape)) for count, action in TASKS[name].push]
    )
    seen = record(
        real.replace(rest_positions=placed), push, jax.random.key(0), every=2, noise=NOISE, occlusion=0.3,
        num_points=256,
    )  # fmt: skip
    found = identify(env, seen, PRIORS, noise=NOISE, starts=4, progress=print)
    print(name, found.values, found.intervals, found.remarks, found.undetermined, f"{found.seconds:.0f} s", flush=True)
    return found.save(path)


def train(name: str, column: str, seed: int, out: Path) -> tuple[Any, Any, dict[str, Any]]:
    """The agent, its trained state, and what the training took."""
    draws = {"truth": lambda: None, "identified": lambda: identified(fit(name, out)), "prior": lambda: hook(PRIORS)}
    env = env_of(name, TRUTH if column == "truth" else None)
    config = sapo_preset(name, "small")
    agent = make_sapo(env, config, randomize=draws[column]())
    began, ts = time.perf_counter(), agent.init(jax.random.key(seed))
    for i in range(config.num_iterations):
        ts, metrics = agent.train_step(ts)
        if i % 20 == 19:
            spent, last = time.perf_counter() - began, float(metrics.get("return", np.nan))
            print(f"{name} {column} {seed}: {i + 1} of {config.num_iterations}, {spent:.0f} s, {last:.2f}", flush=True)
    jax.block_until_ready(ts)
    told = {
        "seconds": round(time.perf_counter() - began), "env_steps": int(ts.env_steps),
        "iterations": config.num_iterations,
    }  # fmt: skip
    return agent, ts, told


def run_cell(task: str, column: str, seed: int, out: Path) -> dict[str, Any]:
    """Train one policy; its evaluation in the true scene."""
    agent, ts, told = train(task, column, seed, out)
    return {**earned(env_of(task, TRUTH), agent.policy, ts, EPISODES), **told}


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the benchmark.

    Attributes:
      tasks, columns, seeds: cells to run, all tasks and columns of a seed first.
      out: folder of the rows and of the fits.
      table: print the tables of the rows and fits that are there, and stop.
    """

    tasks: tuple[str, ...] = tuple(TASKS)
    columns: tuple[str, ...] = COLUMNS
    seeds: tuple[int, ...] = (0, 1, 2)
    out: Path = OUT
    table: bool = False


def tables(rows: list[dict[str, str]], out: Path = OUT) -> str:
    """Markdown: what was found, and the mean return of the seeds in the true scene."""
    lines = ["| task | unknown | true | found, 95 % interval |", "|---|---|---|---|"]
    for name in TASKS:
        told = json.loads((out / f"loop_{name}.json").read_text())
        for unknown, true in TRUTH.items():
            low, high = told["intervals"][unknown]
            found = f"{told['values'][unknown]:.4g}, {low:.4g} to {high:.4g}"
            lines.append(f"| {name} | {unknown.split('.')[-1]} | {true:g} | {found} |")
    lines += ["", "| task | " + " | ".join(COLUMNS) + " |", "|" + "---|" * (len(COLUMNS) + 1)]
    for name in TASKS:
        lines.append(f"| {name} | " + " | ".join(mean(rows, task=name, column=column) for column in COLUMNS) + " |")
    return "\n".join(lines)


def main(args: Args) -> None:
    stored = args.out / "loop.csv"
    if args.table:
        print(tables(read(stored), args.out))
        return
    enable_compilation_cache()
    every = itertools.product(args.seeds, args.tasks, args.columns)
    cells = ({"task": task, "column": column, "seed": seed} for seed, task, column in every)
    fill(cells, functools.partial(run_cell, out=args.out), FIELDS, stored)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
