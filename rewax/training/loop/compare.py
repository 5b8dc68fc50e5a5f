"""Training with the mean return before and after it, as examples report it."""

from pathlib import Path
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
      config: the first and the last evaluation are compared, so ``eval_every`` must be positive, and below
        ``num_iterations`` without ``eval_at_start``.

    Returns:
      Mean return at the first and at the last evaluation.

    Raises:
      ValueError: the run directory has fewer than two evaluations; the message says why.
    """
    result = train(agent, env, config)
    returns = read_csv(f"{config.run_dir}/eval.csv").get("deterministic_mean", ())
    if len(returns) < 2:
        why = "give a positive eval_every, below num_iterations if eval_at_start is False"
        if result.failure or result.signum:
            why = result.failure or "the run was stopped early, and resume=True continues it"
        raise ValueError(f"{config.run_dir} has fewer than two evaluations: {why}")
    before, after = float(returns[0]), float(returns[-1])
    picture = Path(config.run_dir) / "episode.png"
    where = picture if picture.is_file() else config.run_dir
    print(f"return per episode: {before:.1f} before, {after:.1f} after; see {where}")
    return before, after


__all__ = ["train_and_compare"]
