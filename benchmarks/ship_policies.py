"""Put the best policy of each task into the package: weights and a card in rewax/policies.

    python benchmarks/ship_policies.py runs/HandFlip-small-* docs/suites/small/runs/*/*/*
    python benchmarks/ship_policies.py --again FluidMove GripperLift

Takes directories of finished runs, of ``rewax train`` and of ``rewax bench``. Of each task and scale the run with the
highest deterministic return is written, loaded again as a user would, and evaluated with new starts. It is refused if
the loaded policy does not act as the run's to the bit, if its return is not that of the run's own last evaluation, or
if it does not earn more than no action and random actions. A policy that is there already stays unless the new one
earns more or ``--replace`` is given.

After a task has changed, ``--again`` evaluates the policies that are there once more, and writes the returns into their
cards.
"""

import csv
import dataclasses
import json
import math
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

import rewax
from rewax.statistics import bootstrap_interval
from rewax.training import enable_compilation_cache, load_run, make_evaluate
from rewax.training.evaluation.programs import MODES, any_of
from rewax.training.storage.description import provenance, read_config
from rewax.training.storage.policies import FOLDER, load_policy, read_card, save_policy
from rewax.training.storage.saved import SavedRun


@dataclasses.dataclass(frozen=True)
class Args:
    """Options.

    Attributes:
      runs: directories of finished runs.
      out: folder of the policies.
      episodes: of the evaluation.
      seed: draws its starts.
      standard_errors: by which a return may differ from that of the run's own evaluation.
      replace: also policies that earn more than the new ones.
      again: tasks whose policy is evaluated again.
      scale: of these tasks.
    """

    runs: tyro.conf.Positional[tuple[str, ...]] = ()
    out: Path = FOLDER
    episodes: int = 64
    seed: int = 4321
    standard_errors: float = 4.0
    replace: bool = False
    again: tuple[str, ...] = ()
    scale: str = "small"


class Refused(Exception):
    """Why a run's policy is not shipped."""


def last_evaluation(run_dir: Path) -> dict[str, float] | None:
    """Of ``eval.csv``; None: the run is not finished, or cannot be built again."""
    path, config = run_dir / "eval.csv", read_config(run_dir)
    rows = list(csv.DictReader(path.open())) if path.is_file() else []
    if not rows or config.get("env") not in rewax.list_envs() or config.get("agent") == "trajopt":
        return None
    last = {name: float(value) for name, value in rows[-1].items() if value not in ("", None)}
    steps = config["train"].get("num_steps")  # with them a run of AHAC has fewer iterations
    finished = last["iteration"] >= config[config["agent"]]["num_iterations"] or (steps and last["env_steps"] >= steps)
    return last if finished and math.isfinite(last["deterministic_mean"]) else None


def evaluate(run: SavedRun, args: Args) -> dict[str, dict[str, Any]]:
    """Returns of the policy, sampled and deterministic, of no action and of random actions, from the same starts."""
    program, found = make_evaluate(run.env, any_of(run.env, run.agent.policy), args.episodes), {}
    for i, mode in enumerate(MODES):
        result = jax.device_get(program((run.train_state, i), jax.random.key(args.seed)))
        low, high = bootstrap_interval(result["returns"])
        found[mode] = {"mean": float(result["mean"]), "low": low, "high": high, "std": float(result["std"])}
        found[mode] |= {"episodes": args.episodes, "failed": int(result["failed"])}
        found[mode] |= {"success": float(result["success"])} if "success" in result else {}
    return found


def check_actions(run: SavedRun, loaded: SavedRun) -> None:
    """The loaded policy acts as the run's, to the bit."""
    key = jax.random.key(0)
    state = run.env.reset(key)
    for drawn in (None, key):
        there, here = (np.asarray(one.act(state.obs, drawn)) for one in (run, loaded))
        if not np.array_equal(there, here):
            raise Refused(f"the loaded policy acts otherwise, by up to {np.abs(there - here).max():.2g}")


def check_returns(returns: dict[str, dict[str, Any]], recorded: dict[str, float], args: Args) -> None:
    """The returns are those of the run's own evaluation within its error, and better than those of the baselines."""
    for mode in MODES[:2]:
        now, then = returns[mode], recorded[f"{mode}_mean"]
        error = math.hypot(now["std"], recorded[f"{mode}_std"]) / math.sqrt(args.episodes)
        if abs(now["mean"] - then) > args.standard_errors * error + 1e-3 * abs(then):
            raise Refused(f"{mode} it returns {now['mean']:.4g}, not the run's {then:.4g} (standard error {error:.2g})")
    best = max(returns[mode]["mean"] for mode in MODES[2:])
    if returns["deterministic"]["mean"] <= best:
        raise Refused(f"it returns {returns['deterministic']['mean']:.4g}, and a policy that learnt nothing {best:.4g}")


def card(run_dir: Path, run: SavedRun, returns: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """What is known of a policy beside its task and its options."""
    config, options = run.config, run.config.get("train", {})
    seed = config.get("seed", options.get("seed"))
    devices = f" --devices {options['devices']}" if options.get("devices") else ""
    made = f"--env {config['env']} --scale {config['scale']} --algo {config['agent']} --seed {seed}"
    return {
        "command": f"rewax train {made}{devices}",
        "seed": seed,
        "iteration": int(run.train_state.iteration),
        "env_steps": int(run.train_state.env_steps),
        "returns": returns,
        "trained": {**_trained(run_dir, config), "versions": config.get("versions", {})},
        "evaluated": provenance(),
    }


def _trained(run_dir: Path, config: dict[str, Any]) -> dict[str, Any]:
    """Commit, processor, C++ and jax of a run's last part; of a run by an earlier version from ``result.json``."""
    kept, result = config.get("provenance", [])[-1:], run_dir / "result.json"
    if not kept and result.is_file():
        kept = [json.loads(result.read_text())]
    return {name: part[name] for part in kept for name in ("commit", "processor", "cpp", "jax") if name in part}


def ship(run_dir: Path, recorded: dict[str, float], args: Args) -> str:
    """Write the policy of a run if it passes all checks; returns a sentence."""
    run = load_run(run_dir)
    env, scale = run.config["env"], run.config["scale"]
    with tempfile.TemporaryDirectory() as folder:
        save_policy(run, folder, {})
        loaded = load_policy(env, scale=scale, folder=folder)
        check_actions(run, loaded)
        returns = evaluate(loaded, args)
        check_returns(returns, recorded, args)
        path = save_policy(run, folder, card(run_dir, run, returns))
        if not args.replace and (better := _better(env, scale, returns, args)):
            return better
        args.out.mkdir(parents=True, exist_ok=True)
        for suffix in (".npz", ".json"):
            shutil.copyfile(path.with_suffix(suffix), args.out / path.with_suffix(suffix).name)
    size = (args.out / path.name).stat().st_size / 1e3
    return f"wrote {path.stem}, {size:.0f} kB: {_in_words(returns)}"


def ship_again(env: str, args: Args) -> str:
    """Write today's returns into the card of a policy that is there; returns a sentence."""
    returns = evaluate(load_policy(env, scale=args.scale, folder=args.out), args)
    best = max(returns[mode]["mean"] for mode in MODES[2:])
    path = args.out / f"{env}-{args.scale}.json"
    kept = json.loads(path.read_text())
    path.write_text(json.dumps({**kept, "returns": returns, "evaluated": provenance()}, indent=1) + "\n")
    warning = "" if returns["deterministic"]["mean"] > best else ", no more than a policy that learnt nothing"
    return f"evaluated {path.stem} again: {_in_words(returns)}{warning}"


def _in_words(returns: dict[str, dict[str, Any]]) -> str:
    return ", ".join(f"{mode} {of['mean']:.4g} [{of['low']:.4g}, {of['high']:.4g}]" for mode, of in returns.items())


def _better(env: str, scale: str, returns: dict[str, dict[str, Any]], args: Args) -> str:
    """Whether the policy that is there earns as much; a sentence, or nothing."""
    try:
        there = read_card(env, scale=scale, folder=args.out)["returns"]["deterministic"]["mean"]
    except ValueError:
        return ""
    new = returns["deterministic"]["mean"]
    return f"kept {env}-{scale}: it returns {there:.4g}, the new one {new:.4g}" if there >= new else ""


def main(args: Args) -> int:
    """Exit code: 1 if a policy was refused."""
    enable_compilation_cache()
    for env in args.again:
        print(ship_again(env, args), flush=True)
    best: dict[tuple[str, str], tuple[float, Path, dict[str, float]]] = {}
    for run_dir in map(Path, args.runs):
        recorded, config = last_evaluation(run_dir), read_config(run_dir)
        if recorded is None:
            print(f"passed over {run_dir}: not finished, or not a policy of a task of rewax", flush=True)
            continue
        candidate = (recorded["deterministic_mean"], run_dir, recorded)
        task = (config["env"], config["scale"])
        best[task] = max(best.get(task, candidate), candidate, key=lambda one: one[0])
    refused = 0
    for _, run_dir, recorded in best.values():
        try:
            print(ship(run_dir, recorded, args), flush=True)
        except (Refused, ValueError) as error:
            refused += 1
            print(f"refused {run_dir}: {error}", file=sys.stderr, flush=True)
    return int(refused > 0)


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Args, description=__doc__)))
