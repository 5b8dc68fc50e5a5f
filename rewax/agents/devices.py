"""Environments over several devices: a mesh with one axis, and what is computed where.

A program traced under ``jax.set_mesh(mesh_of(...))`` computes each environment on the device that holds it, and all
else on every device. Without such a mesh nothing here changes a program.
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
"""The axis of the mesh, and the name under which ``jax.lax.psum`` knows it."""


def mesh_of(devices: Sequence[object]) -> Mesh:
    """A mesh of some of ``jax.devices()``, over which environments are sharded."""
    return Mesh(np.asarray(devices), (AXIS,), axis_types=(AxisType.Auto,))


def num_shards() -> int:
    """Devices of the mesh that the present program is traced for; 1 without one."""
    mesh = jax.sharding.get_abstract_mesh()
    return 1 if mesh.empty or AXIS not in mesh.axis_names else mesh.shape[AXIS]


def sharded(function: Callable[..., T], args: Sequence[PyTree], split: Sequence[bool], *, same: bool = False) -> T:
    """``function(*args)`` on every device with its share of the arguments' first axis.

    Args:
      function: of trees. It must not close over arrays: a device gets the arguments only.
      args: its arguments.
      split: which of them are split over the devices; the others are the same on all.
      same: all devices return the same, because they took means with ``mean_over_devices``.

    Returns:
      What the function returns, put together along the first axis; with ``same`` what any of them returns.

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
    """Inside of ``sharded``: the mean of all devices' arrays. Elsewhere: the arrays."""
    mesh = jax.sharding.get_abstract_mesh()
    return jax.lax.pmean(tree, AXIS) if AXIS in mesh.manual_axes else tree


def check_closes_over_no_array(function: Callable[..., object]) -> None:
    """Checks that a function has its arrays from its arguments alone.

    An array that it closes over would be a constant of the program, and would not be sharded. Looked through are
    closures, defaults, ``functools.partial``, bound methods, and the containers in them; not global variables.

    Raises:
      ValueError: it closes over an array; the message names the function and the variable.
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
    """Names and values that a function brings with it."""
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
