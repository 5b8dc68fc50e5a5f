"""A new run that begins with what an old one has learnt."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from rewax.agents.run_state import RunState
from rewax.training.storage.saved import load_run

_OF_THE_RUN = ("environments", "key", "iteration", "env_steps", "replay", "learning_rate")
"""Begins anew; and so do the states of optimizers."""


def warm_started(fresh: Any, run_dir: str | Path) -> Any:
    """A fresh training state with the networks, temperatures and statistics of an old run's newest checkpoint.

    Environments, randomness, counters, optimizers and replay buffers begin anew.

    Args:
      fresh: as ``agent.init`` makes it.
      run_dir: directory of the old run, of the same algorithm.

    Raises:
      ValueError: in one sentence: there is no such run, it is of another algorithm, or its networks have other shapes.
    """
    old = load_run(run_dir).train_state
    if type(old) is not type(fresh) or not isinstance(fresh, RunState):
        raise ValueError(f"{run_dir} is no run of this algorithm: begin with one of the same, or without --init-from")
    changes = {name: _like(name, getattr(fresh, name), getattr(old, name), run_dir) for name in _learnt(fresh)}
    statistics = _like("statistics", fresh.environments.statistics, old.environments.statistics, run_dir)
    return fresh.replace(**changes, environments=fresh.environments.replace(statistics=statistics))


def _learnt(state: RunState) -> list[str]:
    """Fields of a state that hold what was learnt."""
    names = [field.name for field in dataclasses.fields(state)]  # type: ignore[arg-type]
    return [name for name in names if name not in _OF_THE_RUN and not name.endswith(("_opt", "opt_state"))]


def _like(name: str, fresh: Any, old: Any, run_dir: str | Path) -> Any:
    """The old value, of the same structure and shapes as the fresh one."""
    same = jax.tree.structure(fresh) == jax.tree.structure(old) and all(
        jnp.shape(a) == jnp.shape(b) for a, b in zip(jax.tree.leaves(fresh), jax.tree.leaves(old), strict=True)
    )
    if not same:
        raise ValueError(
            f"{name} of {run_dir} has other shapes than this run's: give the networks' options that it was trained "
            f"with ({run_dir}/config.json), and a task with the same observations and actions"
        )
    return old


__all__ = ["warm_started"]
