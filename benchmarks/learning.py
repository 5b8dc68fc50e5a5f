"""What trained policies earn, beside no action, the best of random action sequences, and the untrained policy.

    for s in 0 1 2; do rewax train --env HandFlip --scale small --seed $s; done
    python benchmarks/learning.py runs/HandFlip-small-*

Returns over 64 episodes from the same starts. The best of 64 random sequences is the largest of the 64 returns, each
of another sequence; the policies' are means, with sampled and with deterministic actions. Minutes are those of the
iterations, without compilation.
"""

import csv
import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from rewax.training.cache import enable_compilation_cache
from rewax.training.evaluate import make_evaluate
from rewax.training.saved import load_run


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this table."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    episodes: int = 64
    seed: int = 1234


def baselines(env: Any, args: Args) -> dict[str, np.ndarray]:
    """Returns of no action and of uniformly random actions, by episode."""

    def policy(size: jax.Array, obs: Any, key: jax.Array, deterministic: bool = False) -> jax.Array:
        return size * jax.random.uniform(key, env.action_spec.shape, minval=-1.0, maxval=1.0)

    evaluate = make_evaluate(env, policy, args.episodes)
    sizes = {"no action": 0.0, "random": 1.0}
    return {
        name: np.asarray(evaluate(jnp.asarray(s), jax.random.key(args.seed))["returns"]) for name, s in sizes.items()
    }


def main(args: Args) -> int:
    enable_compilation_cache()
    print("| task | seed | sampled / deterministic | success | untrained | no action | best of random | minutes |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    known: dict[tuple[str, str], tuple[dict[str, np.ndarray], Any]] = {}
    for run in args.runs:
        saved = load_run(run)
        kind = (saved.config["env"], saved.config["scale"])
        if kind not in known:
            evaluate = make_evaluate(saved.env, saved.agent.policy, args.episodes)
            known[kind] = baselines(saved.env, args), evaluate
        without, evaluate = known[kind]
        key, seed = jax.random.key(args.seed), int(saved.config["seed"])
        untrained = float(evaluate(saved.agent.init(jax.random.key(seed)), key, deterministic=True)["mean"])
        sampled, fixed = (evaluate(saved.train_state, key, deterministic=d) for d in (False, True))
        success = f"{float(fixed['success']):.0%}" if "success" in fixed else "-"
        with (Path(run) / "timing.csv").open() as file:
            minutes = sum(float(row["seconds"]) for row in csv.DictReader(file)) / 60.0
        print(
            f"| `{kind[0]}` | {seed} | {float(sampled['mean']):.1f} / {float(fixed['mean']):.1f} | {success} "
            f"| {untrained:.1f} | {without['no action'].mean():.1f} | {without['random'].max():.1f} | {minutes:.1f} |",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Args, description=__doc__)))
