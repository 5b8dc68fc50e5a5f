"""Environments over several devices: a mesh with one axis, and what is computed where.

A program traced under ``jax.set_mesh(mesh_of(...))`` computes each environment on the device that holds it, and all
else on every device. Without such a mesh nothing here changes a program.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, PartitionSpec

from rewax.types import PyTree

AXIS = "envs"
"""The axis of the mesh, and the name under which ``jax.lax.psum`` knows it."""


def mesh_of(devices: Sequence[jax.Device]) -> Mesh:
    """A mesh over which environments are divided."""
    return Mesh(np.asarray(devices), (AXIS,), axis_types=(AxisType.Auto,))


def num_shards() -> int:
    """Devices of the mesh that the present program is traced for; 1 without one."""
    mesh = jax.sharding.get_abstract_mesh()
    return 1 if mesh.empty or AXIS not in mesh.axis_names else mesh.shape[AXIS]


def divided(function: Callable[..., Any], args: Sequence[Any], split: Sequence[bool], *, same: bool = False) -> Any:
    """``function(*args)`` on every device with its share of the arguments' first axis.

    Args:
      function: of trees. It must not close over what is computed: a device gets the arguments only.
      args: its arguments.
      split: which of them are divided; the others are the same on all devices.
      same: all devices return the same, because they took means with ``mean_over_devices``.

    Returns:
      What the function returns, put together along the first axis; with ``same`` what any of them returns.
    """
    if num_shards() == 1:
        return function(*args)
    specs = tuple(PartitionSpec(AXIS) if s else PartitionSpec() for s in split)
    out = PartitionSpec() if same else PartitionSpec(AXIS)
    return jax.shard_map(function, in_specs=specs, out_specs=out, check_vma=False)(*args)


def mean_over_devices(tree: PyTree) -> PyTree:
    """Inside of ``divided``: the mean of all devices' arrays. Elsewhere: the arrays."""
    mesh = jax.sharding.get_abstract_mesh()
    return jax.lax.pmean(tree, AXIS) if AXIS in mesh.manual_axes else tree
