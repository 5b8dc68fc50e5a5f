"""Environments sharded over several devices: a mesh with one axis, ``envs``.

A program traced under ``jax.set_mesh(mesh_of(...))`` computes each environment on the device that holds it. The steps
in a replay buffer are sharded alike. Everything else is replicated on every device. Without such a mesh nothing here
changes a program.
"""

import functools
import inspect
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, PartitionSpec

from rewax.types import PyTree

T = TypeVar("T")

AXIS = "envs"
"""Name of the mesh axis, also for ``jax.lax.psum``."""


def mesh_of(devices: Sequence[object], axis: str = AXIS) -> Mesh:
    """A mesh of the given devices with one axis; over ``AXIS`` environments are sharded."""
    return Mesh(np.asarray(devices), (axis,), axis_types=(AxisType.Auto,))


def num_shards() -> int:
    """Number of devices in the mesh of the program that is being traced; 1 without a mesh."""
    mesh = jax.sharding.get_abstract_mesh()
    return 1 if mesh.empty or AXIS not in mesh.axis_names else mesh.shape[AXIS]


def sharded(function: Callable[..., T], args: Sequence[PyTree], split: Sequence[bool], *, same: bool = False) -> T:
    """``function(*args)`` on every device with its shard of the arguments' first axis.

    Args:
      function: a function of pytrees. It must not close over arrays, because a device gets the arguments only.
      args: its arguments.
      split: for each argument, whether it is sharded; the others are replicated.
      same: all devices return the same values, because ``function`` takes means with ``mean_over_devices``.

    Returns:
      The results of all devices, concatenated along the first axis; with ``same`` the result of one device.

    Raises:
      ValueError: the function closes over an array.
    """
    check_closes_over_no_array(function)
    if num_shards() == 1:
        return function(*args)
    specs = tuple(PartitionSpec(AXIS) if s else PartitionSpec() for s in split)
    out = PartitionSpec() if same else PartitionSpec(AXIS)
    return jax.shard_map(function, in_specs=specs, out_specs=out, check_vma=False)(*args)


def mean_over_devices(tree: PyTree) -> PyTree:
    """Inside of ``sharded``: the mean of the arrays over all devices. Elsewhere: the arrays themselves."""
    mesh = jax.sharding.get_abstract_mesh()
    return jax.lax.pmean(tree, AXIS) if AXIS in mesh.manual_axes else tree


def check_closes_over_no_array(function: Callable[..., object]) -> None:
    """Checks that a function gets arrays through its arguments only.

    An array in its closure would be a constant of the program, and would not be sharded. The check looks into closures,
    defaults, ``functools.partial``, bound methods, and the containers in them, but not at global variables.

    Raises:
      ValueError: the function closes over an array; the message names the function and the variable.
    """
    visited: set[int] = set()
    waiting: list[object] = [function]
    while waiting:
        one = waiting.pop()
        if id(one) in visited:
            continue
        visited.add(id(one))
        for name, value in _bound(one):
            leaves = jax.tree.leaves(value)
            if any(isinstance(leaf, jax.Array) for leaf in leaves):
                raise ValueError(
                    f"{_name(one)} closes over {name}, which holds an array: give it as an argument (the argument "
                    "`common` of a loss is the training state), and bind with functools.partial only what is known "
                    "when the program is traced"
                )
            waiting += [leaf for leaf in leaves if callable(leaf)]


def _bound(function: object) -> Iterator[tuple[str, object]]:
    """Names and values that are bound to a function."""
    yield "its function", getattr(function, "__wrapped__", None)  # of jax.jit, for example
    if isinstance(function, functools.partial):
        yield "its function", function.func
        yield from ((f"argument {i}", value) for i, value in enumerate(function.args))
        yield from function.keywords.items()
    elif inspect.ismethod(function):
        yield "self", function.__self__
        yield "its function", function.__func__
    elif inspect.isfunction(function):
        for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
            try:
                yield name, cell.cell_contents
            except ValueError:  # a variable that has no value yet
                continue
        yield from ((f"default {i}", value) for i, value in enumerate(function.__defaults__ or ()))
        yield from (function.__kwdefaults__ or {}).items()


def _name(function: object) -> str:
    inner = function.func if isinstance(function, functools.partial) else function
    return getattr(inner, "__qualname__", repr(inner))
