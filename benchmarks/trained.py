"""Training of one policy in a benchmark, with its progress."""

import time
from typing import Any

import jax
import numpy as np

from rewax.training import make_evaluate


def trained(agent: Any, num_iterations: int, seed: int, name: str) -> tuple[Any, int]:
    """The training state after so many iterations, and the seconds that they took. Prints every tenth return."""
    began, ts = time.perf_counter(), agent.init(jax.random.key(seed))
    for i in range(num_iterations):
        ts, metrics = agent.train_step(ts)
        if i % 10 == 9:
            spent, earned = time.perf_counter() - began, float(metrics.get("return", np.nan))
            print(f"{name} {seed}: {i + 1} of {num_iterations}, {spent:.0f} s, {earned:.2f}", flush=True)
    jax.block_until_ready(ts)
    return ts, round(time.perf_counter() - began)


def earned(env: Any, policy: Any, ts: Any, episodes: int) -> dict[str, float]:
    """Mean and standard deviation of returns, with deterministic actions and always from the same starts."""
    found = make_evaluate(env, policy, episodes)(ts, jax.random.key(99), deterministic=True)
    return {"return": round(float(found["mean"]), 3), "std": round(float(found["std"]), 3)}
