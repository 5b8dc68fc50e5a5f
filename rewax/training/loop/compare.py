"""Training with the mean return before and after it, as examples report it."""

from typing import Any

from rewax.envs.base import Env
from rewax.training.config import TrainConfig
from rewax.training.loop.train import train
from rewax.training.storage.metrics import read_csv


def train_and_compare(agent: Any, env: Env, config: TrainConfig) -> tuple[float, float]:
    """Train an agent, and print the mean return of deterministic episodes before and after.

    Args:
      agent: the agent, from ``make_sapo(env, ...)`` for example.
      env: the environment of the evaluations.
      config: ``eval_every`` must be set: the first and the last evaluation are compared.

    Returns:
      Mean return at the first and at the last evaluation.

    Raises:
      ValueError: the run directory has fewer than two evaluations.
    """
    train(agent, env, config)
    returns = read_csv(f"{config.run_dir}/eval.csv").get("deterministic_mean", ())
    if len(returns) < 2:
        raise ValueError(f"{config.run_dir} has {len(returns)} evaluations: set eval_every to at most num_iterations")
    before, after = float(returns[0]), float(returns[-1])
    print(f"return per episode: {before:.1f} before, {after:.1f} after; see {config.run_dir}/episode.png")
    return before, after


__all__ = ["train_and_compare"]
