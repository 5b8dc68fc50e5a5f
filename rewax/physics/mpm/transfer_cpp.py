"""The kernels of ``transfer`` in C++, for CPUs; those of ``transfer_xla_cpu`` without a compiler.

One call computes a whole transfer: a particle's weights and its 27 nodes stay in registers and in the first-level
cache, where XLA stores the 27 values of every particle. ``transfer.cc`` has the loops; results equal those of
``transfer_xla_cpu`` up to rounding. The threads of the device share the environments.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering import build, report
from rewax.lowering.linear_primitive import Arrays
from rewax.physics.mpm import transfer_xla_cpu
from rewax.physics.mpm.transfer_xla_cpu import Layout

SOURCE = build.Source("transfer", build.THREADS.read_text() + Path(__file__).with_name("transfer.cc").read_text())
_NAME = "rewax.physics.mpm.transfer"
_TARGETS = ("rewax_scatter", "rewax_gather_values", "rewax_scatter_tangent_transpose", "rewax_gather_tangent_transpose")
_TYPES = (np.dtype(np.float32), np.dtype(np.float64))


def scatter(layout: Layout, residuals: Arrays, linear: Arrays) -> Arrays:
    """As ``transfer_xla_cpu.scatter``."""
    num_fields = len(linear) - 9
    if not _available(residuals, linear):
        return transfer_xla_cpu.scatter(layout, residuals, linear)
    return _call("rewax_scatter", layout, (*residuals, *linear), [layout.num_nodes] * num_fields, num_fields)


def gather_values(layout: Layout, residuals: Arrays, nodes: Arrays) -> Arrays:
    """As ``transfer_xla_cpu.gather_values``."""
    if not _available(residuals, nodes):
        return transfer_xla_cpu.gather_values(layout, residuals, nodes)
    lengths = [residuals[0].shape[-1]] * (len(nodes) + 9)
    return _call("rewax_gather_values", layout, (*residuals, *nodes), lengths, len(nodes))


def scatter_tangent_transpose(layout: Layout, residuals: Arrays, cotangents: Arrays) -> Arrays:
    """As ``transfer_xla_cpu.scatter_tangent_transpose``."""
    if not _available(residuals, cotangents):
        return transfer_xla_cpu.scatter_tangent_transpose(layout, residuals, cotangents)
    lengths = [residuals[0].shape[-1]] * 16
    return _call("rewax_scatter_tangent_transpose", layout, (*residuals, *cotangents), lengths, 4)


def gather_tangent_transpose(layout: Layout, residuals: Arrays, cotangents: Arrays) -> Arrays:
    """As ``transfer_xla_cpu.gather_tangent_transpose``."""
    if not _available(residuals, cotangents):
        return transfer_xla_cpu.gather_tangent_transpose(layout, residuals, cotangents)
    lengths = [residuals[0].shape[-1]] * 3 + [layout.num_nodes] * 3
    return _call("rewax_gather_tangent_transpose", layout, (*residuals, *cotangents), lengths, 3)


def is_used() -> bool:
    """Whether programs for CPUs use these kernels, which requires that they could be built."""
    return build.is_usable(SOURCE, _TARGETS, _NAME)


def _available(*arrays: Arrays) -> bool:
    types = {a.dtype for group in arrays for a in group if jnp.issubdtype(a.dtype, jnp.floating)}
    fits = len(types) == 1 and types <= set(_TYPES)
    if not fits and not build.is_off():
        report.note(_NAME, "value", "its arrays are not of one floating type, float32 or float64")
    return fits and is_used()


def _call(target: str, layout: Layout, operands: Arrays, lengths: Sequence[int], num_fields: int) -> Arrays:
    """One kernel over arrays (..., particles) and (..., nodes); all results have the operands' leading axes."""
    grid, first = layout.grid, operands[0]
    transfer_xla_cpu.check_size(layout, math.prod(first.shape[:-1]))
    sizes = (*grid.shape, layout.num_nodes, layout.num_active is not None, num_fields)
    shapes = [jax.ShapeDtypeStruct((*first.shape[:-1], length), first.dtype) for length in lengths]
    run = jax.ffi.ffi_call(target, shapes)
    return tuple(run(*operands, sizes=np.asarray(sizes, np.int64), box=np.asarray((*grid.origin, grid.spacing))))
