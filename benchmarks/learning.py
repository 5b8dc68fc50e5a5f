"""What trained policies earn, beside no action, the best of random action sequences, and the untrained policy.

    for s in 0 1 2; do rewax train --env HandFlip --scale small --seed $s; done
    python benchmarks/learning.py runs/HandFlip-small-* --out docs/tasks/results.csv

Rows of other runs stay in the file that ``--out`` names; ``benchmarks/gallery.py`` makes pages of it.

Mean returns of 64 episodes from the same starts, with sampled and with deterministic actions. Of 64 random sequences of
actions, each one taken from the same four starts: the mean, and that of the best sequence. Minutes are the
number of iterations times the median of their times, without compilation.
"""

import csv
import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from rewax.training import constant_policy, enable_compilation_cache, evaluate_actions, load_run, make_evaluate


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this table."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    episodes: int = 64
    sequences: int = 64
    starts: int = 4
    seed: int = 1234
    out: Path | None = None


COLUMNS = (
    "env",
    "scale",
    "agent",
    "seed",
    "env_steps",
    "sampled",
    "deterministic",
    "success",
    "untrained",
    "no_action",
    "random_mean",
    "random_best",
    "minutes",
)


def baselines(env: Any, args: Args) -> dict[str, float]:
    """Mean returns of no action, and of uniformly random sequences: their mean, and that of the best of them."""
    key, shape = jax.random.key(args.seed), (env.episode_length, *env.action_spec.shape)
    without = make_evaluate(env, constant_policy(jnp.zeros(env.action_spec.shape)), args.episodes)(None, key)
    low, high = env.action_spec.low, env.action_spec.high
    sequences = (
        jax.random.uniform(jax.random.fold_in(key, i), shape, minval=low, maxval=high) for i in range(args.sequences)
    )
    found = np.array([float(evaluate_actions(env, actions, key, args.starts)["mean"]) for actions in sequences])
    return {"no_action": float(without["mean"]), "random_mean": float(found.mean()), "random_best": float(found.max())}


def measured(run: str, args: Args, known: dict[tuple[str, str], Any]) -> dict[str, Any]:
    """A row; what belongs to the task alone is computed once and kept in ``known``."""
    saved = load_run(run)
    kind = (saved.config["env"], saved.config["scale"])
    if kind not in known:
        known[kind] = (
            baselines(saved.env, args),
            saved.agent,
            make_evaluate(saved.env, saved.agent.policy, args.episodes),
        )
    without, agent, evaluate = known[kind]
    if agent.config != saved.agent.config:
        evaluate = make_evaluate(saved.env, saved.agent.policy, args.episodes)
    key, seed = jax.random.key(args.seed), int(saved.config.get("seed", saved.config["train"]["seed"]))
    untrained = evaluate(saved.agent.init(jax.random.key(seed)), key, deterministic=True)
    sampled, fixed = (evaluate(saved.train_state, key, deterministic=d) for d in (False, True))
    with (Path(run) / "timing.csv").open() as file:
        seconds = [float(row["seconds"]) for row in csv.DictReader(file)]
        minutes = len(seconds) * float(np.median(seconds)) / 60.0  # other work on the machine stretches a few
    return {
        "env": kind[0],
        "scale": kind[1],
        "agent": saved.config["agent"],
        "seed": seed,
        "env_steps": int(saved.train_state.env_steps),
        "sampled": round(float(sampled["mean"]), 2),
        "deterministic": round(float(fixed["mean"]), 2),
        "success": round(float(fixed["success"]), 3) if "success" in fixed else "",
        "untrained": round(float(untrained["mean"]), 2),
        **{name: round(value, 2) for name, value in without.items()},
        "minutes": round(minutes, 1),
    }


def main(args: Args) -> int:
    enable_compilation_cache()
    print("| task | seed | sampled / deterministic | success | untrained | no action | best of random | minutes |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    known: dict[tuple[str, str], Any] = {}
    for run in args.runs:
        row = measured(run, args, known)
        success = f"{row['success']:.0%}" if row["success"] != "" else "-"
        print(
            f"| `{row['env']}` | {row['seed']} | {row['sampled']:.1f} / {row['deterministic']:.1f} | {success} "
            f"| {row['untrained']:.1f} | {row['no_action']:.1f} | {row['random_best']:.1f} | {row['minutes']:.1f} |",
            flush=True,
        )
        if args.out is not None:
            keep(row, args.out)
    return 0


def keep(row: dict[str, Any], path: Path) -> None:
    """Write a row into a CSV file, in place of an older one of the same run."""
    name = ("env", "scale", "agent", "seed")
    rows = list(csv.DictReader(path.open())) if path.is_file() else []
    rows = [old for old in rows if [old[n] for n in name] != [str(row[n]) for n in name]]
    rows = sorted([*rows, row], key=lambda r: tuple(str(r[n]) for n in name))
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Args, description=__doc__)))
