"""Pages of the environments: what a policy does, what it sees and does, what it earns, how it learnt.

    python benchmarks/learning.py runs/HandFlip-small-* --out docs/tasks/results.csv
    python benchmarks/gallery.py runs/HandFlip-small-*

Pictures and curves are made of the runs, seeds of one task and algorithm at scale ``small``; numbers are read from the
CSV file. Pages of tasks whose runs are not named are written too, with the pictures that are there; pages of tasks
without rows in that file (cloth and ropes: ``rewax bench thin``) stay as they are.
"""

import csv
import dataclasses
import inspect
import re
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from PIL import Image

import rewax
from rewax.statistics import learning_curve
from rewax.training import enable_compilation_cache, load_run, read_csv, record
from rewax.viz.curves import curves_of_seeds
from rewax.viz.render import pictures
from rewax.viz.surface import has_surfaces

FRAMES = 5
SIZE = (204, 272)
THIN = ("HandFlip", "SoftJumperMPM")
"""Tasks whose material is a few particles thick somewhere: spheres show it better than a surface."""


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of these pages."""

    runs: tyro.conf.Positional[tuple[str, ...]] = ()
    out: Path = Path("docs/tasks")
    seed: int = 1234


def strip(runs: list[Any], path: Path, args: Args) -> None:
    """Moments of an episode of the first run, side by side."""
    saved = runs[0]
    env = getattr(saved.env, "unwrapped", saved.env)
    recording = record(env, saved.agent.policy, saved.train_state, jax.random.key(args.seed)).subsample(FRAMES)
    surface = has_surfaces(recording) and saved.config["env"] not in THIN
    frames = list(pictures(recording, size=SIZE, renderer="software", surface=surface))
    Image.fromarray(np.concatenate(frames, axis=1)).save(path, quality=88, optimize=True)


def curve(directories: list[str], name: str, agent: str, rows: list[dict[str, str]], path: Path) -> None:
    """Returns while the seeds were trained."""
    curves = [learning_curve(read_csv(Path(directory) / "metrics.csv")) for directory in directories]
    levels = {"no action": float(rows[0]["no_action"]), "random actions": float(rows[0]["random_mean"])} if rows else {}
    curves_of_seeds({agent: curves}, path, title=f"{name}, small", levels=levels)
    Image.open(path).convert("RGB").quantize(32, dither=Image.Dither.NONE).save(path, optimize=True)


def specification(name: str) -> list[str]:
    """A table of both scales."""
    envs = [rewax.make(name, scale=scale) for scale in ("small", "paper")]
    facts: dict[str, list[str]] = {}

    def add(what: str, values: list[Any]) -> None:
        if any(value is not None for value in values):
            facts[what] = ["-" if value is None else str(value) for value in values]

    specs = [env.observation_spec for env in envs]
    for key in dict.fromkeys(key for spec in specs for key in spec):
        add(f"observation `{key}`", [tuple(spec[key].shape) if key in spec else None for spec in specs])
    add("actions", [env.action_spec.shape[0] for env in envs])
    add("control step [ms]", [f"{1e3 * float(env.control_dt):.4g}" for env in envs])
    add("substeps of a control step", [getattr(env, "num_substeps", None) for env in envs])
    add("steps of an episode", [env.episode_length for env in envs])
    particles = [
        env.particles(env.reset(jax.random.key(0)).physics).shape[0] if hasattr(env, "particles") else None
        for env in envs
    ]
    add("particles or vertices", particles)
    lines = ["| | small | paper |", "|---|---|---|"]
    return lines + [f"| {what} | {' | '.join(values)} |" for what, values in facts.items()]


def earned(rows: list[dict[str, str]]) -> list[str]:
    """A table of the seeds."""
    lines = [
        "Each row shows mean returns of 64 episodes:",
        "",
        "| seed | sampled | deterministic | succeeded, deterministic | untrained | no action | random: mean, best "
        "of 64 | minutes |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        success = f"{float(row['success']):.0%}" if row["success"] else "-"
        lines.append(
            f"| {row['seed']} | {_number(row['sampled'])} | {_number(row['deterministic'])} | {success} "
            f"| {_number(row['untrained'])} | {_number(row['no_action'])} "
            f"| {_number(row['random_mean'])}, {_number(row['random_best'])} | {float(row['minutes']):.1f} |"
        )
    return lines


def _number(text: str) -> str:
    value = float(text)
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.1f}"


def page(name: str, rows: list[dict[str, str]], out: Path) -> None:
    env = rewax.make(name, scale="small")
    home = type(env)
    said = inspect.getmodule(home).__doc__ or ""  # type: ignore[union-attr]
    first = re.sub(r"``(.*?)``", r"`\1`", said.split("\n\n")[0].replace("\n", " "))
    source = Path(inspect.getsourcefile(home) or "").resolve().relative_to(Path(rewax.__file__).resolve().parent.parent)
    lines = [f"# {name}", "", first, ""]
    if (out / f"{name}.jpg").is_file():
        lines += [f"![{name}: an episode of a trained policy]({name}.jpg)", ""]
    lines += [*specification(name), "", f"Source: `{source}`", "", "## Returns of SAPO", ""]
    steps = int(rows[0]["env_steps"])
    lines += [
        f"    rewax train --env={name} --scale small --seed {rows[0]['seed']}     # {steps:,} environment steps",
        f"    python benchmarks/learning.py runs/{name}-small-* --out docs/tasks/results.csv",
        "",
        *earned(rows),
        "",
        "Minutes are the number of iterations times the median of their times. Compilation is not included.",
        "",
    ]
    if (out / f"{name}_curve.png").is_file():
        lines += [f"![{name}: learning curve]({name}_curve.png)", ""]
    (out / f"{name}.md").write_text("\n".join(lines))


def index(results: dict[str, list[dict[str, str]]], out: Path) -> None:
    lines = [
        "# The environments",
        "",
        "At scale `small`, returns of 64 episodes after training with SAPO, deterministic actions, mean over seeds:",
        "",
        "    python benchmarks/learning.py runs/* --out docs/tasks/results.csv && python benchmarks/gallery.py runs/*",
        "",
        "| | environment | trained | seeds | no action | best of 64 random | minutes |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in rewax.list_envs():
        rows = results.get(name, [])
        shown = f"![]({name}.jpg)" if (out / f"{name}.jpg").is_file() else ""
        numbers = "[returns](../cloth_tasks.md#returns) | | | | |"
        if rows:
            mean = np.mean([float(row["deterministic"]) for row in rows])
            minutes = np.mean([float(row["minutes"]) for row in rows])
            numbers = (
                f"{_number(str(mean))} | {len(rows)} | {_number(rows[0]['no_action'])} "
                f"| {_number(rows[0]['random_best'])} | {minutes:.1f} |"
            )
        lines.append(f"| {shown} | [{name}]({name}.md) | {numbers}")
    (out / "index.md").write_text("\n".join(lines) + "\n")


def main(args: Args) -> int:
    enable_compilation_cache()
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / "results.csv"
    results: dict[str, list[dict[str, str]]] = {}
    for row in csv.DictReader(path.open()) if path.is_file() else ():
        if (row["scale"], row["agent"]) == ("small", "sapo"):
            results.setdefault(row["env"], []).append(row)
    groups: dict[str, list[str]] = {}
    for directory in args.runs:
        groups.setdefault(load_run(directory).config["env"], []).append(directory)
    for name, directories in groups.items():
        runs = [load_run(directories[0])]
        strip(runs, args.out / f"{name}.jpg", args)
        curve(directories, name, runs[0].config["agent"], results.get(name, []), args.out / f"{name}_curve.png")
        print(f"drew {name}", flush=True)
    for name, rows in results.items():
        page(name, rows, args.out)
    index(results, args.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Args, description=__doc__)))
