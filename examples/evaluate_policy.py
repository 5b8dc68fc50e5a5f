"""Evaluate what a run has learnt: ``python examples/evaluate_policy.py --run-dir runs/RollingFlat-small-0``."""

import os
import sys

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # jax 0.10 prints an "error" for every program found in its cache

import jax
import tyro

from rewax.training.cache import enable_compilation_cache
from rewax.training.evaluate import make_evaluate
from rewax.training.saved import load_run


def main(run_dir: str, episodes: int = 64, seed: int = 0, step: int | None = None) -> None:
    """Returns of sampled and deterministic actions, over episodes from random starts.

    Args:
      run_dir: directory of the run.
      episodes: how many.
      seed: draws the starts; the same seed gives the same ones to every policy.
      step: iteration of the checkpoint, the newest by default.
    """
    enable_compilation_cache()
    run = load_run(run_dir, step=step)
    evaluate = make_evaluate(run.env, run.agent.policy, episodes)
    print(f"{run.config['agent']} on {run.config['env']}, iteration {int(run.train_state.iteration)}")
    for name, deterministic in (("sampled", False), ("deterministic", True)):
        result = evaluate(run.train_state, jax.random.key(seed), deterministic=deterministic)
        numbers = ", ".join(f"{what} {float(result[what]):.4g}" for what in ("mean", "std", "min", "max"))
        print(f"{name:13s} {numbers}, {int(result['failed'])} of {episodes} failed")


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except ValueError as error:
        sys.exit(f"error: {error}")
