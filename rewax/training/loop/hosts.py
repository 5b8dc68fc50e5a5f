"""Several processes, on one machine or many, that train one run.

All hold the same program and a part of its environments. The first of them leads: it alone reads and writes the run's
directory, evaluates and speaks. The others do what it says, for a program over all devices runs on all or on none.
"""

import enum
import os
from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

from rewax.training.storage.leaves import from_numpy, is_key, to_numpy

T = TypeVar("T")
_SETTINGS = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
_REMEDY = f"set {', '.join(_SETTINGS[:2])} and {_SETTINGS[2]} for each process, or start them with Slurm or MPI"


class Word(enum.IntEnum):
    """What the leader says to the others."""

    STEP = 0
    """Do an iteration."""
    GATHER = 1
    """Hand over your environments."""
    END = 2
    """Leave."""


def num_processes(environment: Mapping[str, str] = os.environ) -> int | None:
    """How many train together, as far as ``JAX_NUM_PROCESSES`` says.

    Raises:
      ValueError: it is no number.
    """
    return _number(environment, _SETTINGS[1])


def connect(environment: Mapping[str, str] = os.environ) -> None:
    """Join the processes that train together; before JAX computes anything.

    Args:
      environment: holds ``JAX_COORDINATOR_ADDRESS`` (host:port of the first process), ``JAX_NUM_PROCESSES`` and
        ``JAX_PROCESS_ID`` (from 0); what it lacks is asked of Slurm, MPI or the cloud, as JAX knows them. The process's
        own environment by default.

    Raises:
      ValueError: in one sentence: who the others are is not known, or they do not answer.
    """
    count, index = (_number(environment, name) for name in _SETTINGS[1:])
    try:
        jax.distributed.initialize(environment.get(_SETTINGS[0]), count, index)
        # Now, while all are here: on a CPU connections are refused to whoever comes half a minute late.
        multihost_utils.sync_global_devices("rewax")
    except (ValueError, RuntimeError) as error:
        reason = str(error).strip().split("\n")[0].rstrip(".")
        raise ValueError(f"cannot join the other processes ({reason}): {_REMEDY}") from error


def _number(environment: Mapping[str, str], name: str) -> int | None:
    value = environment.get(name)
    if value is None:
        return None
    if not value.isdecimal():
        raise ValueError(f"{name} is {value!r}: {_REMEDY}")
    return int(value)


def leads() -> bool:
    """Whether this process is the first, or the only one."""
    return jax.process_index() == 0


class Leader:
    """What the first process says to the others. Alone it says nothing."""

    def __init__(self) -> None:
        self._several = jax.process_count() > 1

    def hand_out(self, train_state: T) -> T:
        """Give all processes the state to begin with."""
        if self._several:
            _say(Word.STEP)
            _shared(train_state)
        return train_state

    def step(self) -> None:
        """All processes do an iteration."""
        self._tell(Word.STEP)

    def gathered(self, train_state: T) -> T:
        """The whole state, on this process."""
        if not self._several:
            return train_state
        _say(Word.GATHER)
        return _gathered(train_state)

    def end(self) -> None:
        """The others leave."""
        self._tell(Word.END)

    def _tell(self, word: Word) -> None:
        if self._several:
            _say(word)


def received(like: T) -> T | None:
    """The training state that the leader hands out, in place of one of the same shapes; None if there is none."""
    return None if _heard() is Word.END else _shared(like)


def follow(train_step: Any, train_state: T) -> T:
    """Do what the leader says until it says to leave."""
    while (word := _heard()) is not Word.END:
        if word is Word.GATHER:
            _gathered(train_state)
        else:
            train_state, _ = train_step(train_state)
    return train_state


def _say(word: Word) -> None:
    multihost_utils.broadcast_one_to_all(np.int32(word))


def _heard() -> Word:
    return Word(int(multihost_utils.broadcast_one_to_all(np.int32(0))))


def _shared(tree: T) -> T:
    """The first process's numbers, on each."""
    leaves, treedef = jax.tree.flatten(tree)
    numbers = multihost_utils.broadcast_one_to_all([to_numpy(leaf) for leaf in leaves])
    return jax.tree.unflatten(treedef, [_like(value, leaf) for value, leaf in zip(numbers, leaves, strict=True)])


def _gathered(tree: T) -> T:
    """All environments, on each process; what is the same on all is not sent."""
    leaves, treedef = jax.tree.flatten(tree)
    data = [jax.random.key_data(leaf) if is_key(leaf) else leaf for leaf in leaves]
    numbers = [a if _whole(a) else multihost_utils.process_allgather(a, tiled=True) for a in data]
    return jax.tree.unflatten(treedef, [_like(value, leaf) for value, leaf in zip(numbers, leaves, strict=True)])


def _whole(array: Any) -> bool:
    return not isinstance(array, jax.Array) or array.is_fully_replicated or array.is_fully_addressable


def _like(value: Any, leaf: Any) -> Any:
    value = np.asarray(value)
    return from_numpy(value, None, str(jax.random.key_impl(leaf)) if is_key(leaf) else None)


__all__ = ["Leader", "Word", "connect", "follow", "leads", "num_processes", "received"]
