"""Initial training state of a new run with the networks of an old one."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

from rewax.agents.run_state import RunState
from rewax.training.storage import checkpoint
from rewax.training.storage.description import read_config
from rewax.training.storage.leaves import describe_leaf, from_numpy, named_leaves, to_numpy

_OF_THE_RUN = ("environments", "key", "iteration", "env_steps", "replay", "learning_rate", "variance", "horizon")
"""Fields of a training state that are not taken over; states of optimizers are not either."""
_STATISTICS = ".environments.statistics"


def warm_started(fresh: Any, run_dir: str | Path, name: str = "") -> Any:
    """A fresh training state with the networks, temperatures and statistics of an old run's newest checkpoint.

    Environments, random keys, counters, optimizers and replay buffers stay those of the fresh state. The checkpoint is
    read by the names of its arrays, so neither the old run's environment nor its algorithm has to be registered.

    Args:
      fresh: the state that ``agent.init`` returns.
      run_dir: directory of the old run, of the same algorithm.
      name: of the algorithm; empty for one without a name.

    Raises:
      ValueError: in one sentence: there is no such run, it is of another algorithm, or its networks have other shapes.
    """
    if checkpoint.latest_step(run_dir) is None:
        raise ValueError(f"{run_dir} holds no complete checkpoint: check the path")
    if not isinstance(fresh, RunState):
        raise ValueError(
            f"the training state of {name or 'this algorithm'} is no RunState, so nothing can be taken over from "
            f"{run_dir}: begin without --init-from"
        )
    old = {key: leaf for key, leaf in checkpoint.stored_leaves(run_dir).items() if _is_learnt(key)}
    new = {key: leaf for key, leaf in named_leaves(fresh) if _is_learnt(key)}
    _check_fields(old, new, run_dir, name)
    for key in {**new, **old}:
        if key not in old or key not in new or _signature(old[key]) != _signature(new[key]):
            raise ValueError(
                f"{_field(key)} of {run_dir} has other shapes than this run's: give the networks' options that it was "
                f"trained with ({run_dir}/config.json), and a task with the same observations and actions"
            )
    leaves = [from_numpy(to_numpy(old[key]), leaf, None) if key in old else leaf for key, leaf in named_leaves(fresh)]
    return jax.tree.unflatten(jax.tree.structure(fresh), leaves)


def _is_learnt(key: str) -> bool:
    """Whether a leaf of a training state, given by its name, is taken over."""
    field = _field(key)
    kept = field not in _OF_THE_RUN and not field.endswith(("_opt", "opt_state"))
    return kept or key.startswith(_STATISTICS)


def _field(key: str) -> str:
    """The field of the training state that a leaf belongs to."""
    return "statistics" if key.startswith(_STATISTICS) else re.split(r"[.\[]", key.removeprefix("."))[0]


def _signature(leaf: Any) -> tuple[Any, ...]:
    described = describe_leaf(leaf, to_numpy(leaf))
    return tuple(described["shape"]), described["dtype"]


def _check_fields(old: Mapping[str, Any], new: Mapping[str, Any], run_dir: str | Path, name: str) -> None:
    """Raises ValueError if the two sets of leaves belong to different algorithms."""
    there, here = {_field(key) for key in old}, {_field(key) for key in new}
    if there != here:
        algorithm = read_config(run_dir).get("agent") or "another algorithm"
        odd = sorted(there ^ here)[0]
        whose = f"it has learnt {odd}, which" if odd in there else f"it has not learnt {odd}, which"
        verb = "does not have" if odd in there else "needs"
        raise ValueError(
            f"{run_dir} was trained with {algorithm}: {whose} {name or 'this algorithm'} {verb}: begin with a run of "
            "the same algorithm, or without --init-from"
        )


__all__ = ["warm_started"]
