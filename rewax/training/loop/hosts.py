"""One run trained by several processes, on one machine or many.

All processes have the same program, and each has a shard of the environments. The first process leads: it alone reads
and writes the run's directory, evaluates and prints. The others follow its commands, because a program over all devices
has to be started by every process.
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


class Command(enum.IntEnum):
    """A command of the leader to the other processes."""

    STEP = 0
    """Do an iteration of training."""
    GATHER = 1
    """Send your shard of the environments."""
    END = 2
    """End."""
    BACK = 3
    """Return to the state before the last iteration."""


def num_processes(environment: Mapping[str, str] = os.environ) -> int | None:
    """Number of processes of the run: the value of ``JAX_NUM_PROCESSES``, None without it.

    Raises:
      ValueError: it is not a number.
    """
    return _number(environment, _SETTINGS[1])


def connect(environment: Mapping[str, str] = os.environ) -> None:
    """Join the other processes of the run; call it before JAX computes anything.

    Args:
      environment: holds ``JAX_COORDINATOR_ADDRESS`` (host:port of the first process), ``JAX_NUM_PROCESSES`` and
        ``JAX_PROCESS_ID`` (from 0); JAX asks Slurm, MPI or the cloud for missing ones. By default the environment
        variables of this process.

    Raises:
      ValueError: in one sentence: the other processes are not known, or they do not answer.
    """
    count, index = (_number(environment, name) for name in _SETTINGS[1:])
    try:
        jax.distributed.initialize(environment.get(_SETTINGS[0]), count, index)
        # Connect now: on a CPU a process that comes half a minute later than the others is refused.
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
    """Commands of the first process to the others; a process alone sends none."""

    def __init__(self) -> None:
        self._several = jax.process_count() > 1

    def hand_out(self, train_state: T) -> T:
        """Send the initial state to all processes."""
        if self._several:
            _send(Command.STEP)
            _shared(train_state)
        return train_state

    def step(self) -> None:
        """All processes do an iteration of training."""
        self._tell(Command.STEP)

    def gathered(self, train_state: T) -> T:
        """The state with all environments, on this process."""
        if not self._several:
            return train_state
        _send(Command.GATHER)
        return _gathered(train_state)

    def back(self) -> None:
        """The other processes return to the state before the last iteration."""
        self._tell(Command.BACK)

    def end(self) -> None:
        """The other processes end."""
        self._tell(Command.END)

    def _tell(self, command: Command) -> None:
        if self._several:
            _send(command)


def received(like: T) -> T | None:
    """The training state that the leader sends, None if it sends none; ``like`` has the same shapes."""
    return None if _next_command() is Command.END else _shared(like)


def follow(train_step: Any, train_state: T) -> T:
    """Follow the leader's commands until it sends ``END``."""
    before = train_state
    while (command := _next_command()) is not Command.END:
        if command is Command.GATHER:
            _gathered(train_state)
        elif command is Command.BACK:
            train_state = before
        else:
            before = train_state
            train_state, _ = train_step(train_state)
    return train_state


def _send(command: Command) -> None:
    multihost_utils.broadcast_one_to_all(np.int32(command))


def _next_command() -> Command:
    return Command(int(multihost_utils.broadcast_one_to_all(np.int32(0))))


def _shared(tree: T) -> T:
    """The arrays of the first process, on every process."""
    leaves, treedef = jax.tree.flatten(tree)
    numbers = multihost_utils.broadcast_one_to_all([to_numpy(leaf) for leaf in leaves])
    return jax.tree.unflatten(treedef, [_like(value, leaf) for value, leaf in zip(numbers, leaves, strict=True)])


def _gathered(tree: T) -> T:
    """All environments, on every process; replicated arrays are not sent."""
    leaves, treedef = jax.tree.flatten(tree)
    data = [jax.random.key_data(leaf) if is_key(leaf) else leaf for leaf in leaves]
    numbers = [a if _whole(a) else multihost_utils.process_allgather(a, tiled=True) for a in data]
    return jax.tree.unflatten(treedef, [_like(value, leaf) for value, leaf in zip(numbers, leaves, strict=True)])


def _whole(array: Any) -> bool:
    return not isinstance(array, jax.Array) or array.is_fully_replicated or array.is_fully_addressable


def _like(value: Any, leaf: Any) -> Any:
    value = np.asarray(value)
    return from_numpy(value, None, str(jax.random.key_impl(leaf)) if is_key(leaf) else None)


__all__ = ["Command", "Leader", "connect", "follow", "leads", "num_processes", "received"]
