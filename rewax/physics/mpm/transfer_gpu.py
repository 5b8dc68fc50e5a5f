"""The transfers for GPUs: few kernels, and nothing stored between them that can be recomputed.

The kernels store the indices of a particle's nodes, a message of 16 numbers per particle, and sums. They recompute
weights from positions. The scatter treats nodes as rows of four numbers and adds a row by one vector atomic. Results
equal those of ``transfer_xla_cpu`` up to rounding.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.fusion import compute_once
from rewax.lowering.linear_primitive import Arrays
from rewax.physics.mpm.splines import lowest_node
from rewax.physics.mpm.transfer_xla_cpu import (
    SLOPE_MOMENTS,
    VALUE_MOMENTS,
    Layout,
    as_matrix,
    as_vector,
    cotangent_by_slopes,
    env_of_particles,
    flat,
    lowest_rows,
    split,
    tangent_by_slopes,
)
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Mat3
from rewax.types import Array

_IN_BOUNDS = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
_WIDTH = 4
"""Numbers per node, added by one vector atomic: mass and momentum, or momentum and a zero."""
_ADD_ROWS = jax.lax.ScatterDimensionNumbers(
    update_window_dims=(1, 2), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
)
_TAKE = jax.lax.GatherDimensionNumbers(offset_dims=(), collapsed_slice_dims=(0,), start_index_map=(0,))


class _Stencils(NamedTuple):
    """Node indices and fractions of all particles of all environments, N in total."""

    rows: Array
    """Index of the lowest of three nodes along z in each of 9 columns, shape (9, N), int32."""
    fractions: Array
    """Distance from the lowest node along each axis in cells, in [0.5, 1.5), shape (3, N)."""
    spacing: float
    batch: tuple[int, ...]
    """Shape of the particle arrays before flattening."""
    num_nodes: int
    """Number of nodes of all environments."""


class _Axis(NamedTuple):
    """Factors of a node along one axis, broadcastable arrays."""

    w: Array
    """Weight [-]."""
    s: Array
    """Its slope [1/m]."""
    d: Array
    """Offset of the node [m]."""


def scatter(layout: Layout, residuals: Arrays, linear: Arrays) -> Arrays:
    """Sum w (mass, p + A d) onto nodes. residuals: locations; linear: mass (or none), p, A."""
    st, _ = _stencils(layout, residuals)
    st, message = _apart(st, jnp.stack(_message(linear[:-9], as_matrix(linear[-9:])), axis=-1))
    shape = (3, 3, len(message), 3, _WIDTH)  # columns along x and y, particles, nodes along z, numbers
    steps = [jax.lax.broadcasted_iota(jnp.int32, shape, axis) for axis in (0, 1, 3)]
    x, y, z = (_any_node(st, a, steps[a]) for a in cp.AXES)
    value, *slopes = (message[:, None, _WIDTH * i : _WIDTH * (i + 1)] for i in range(4))
    sent = value + slopes[0] * x.d + slopes[1] * y.d + slopes[2] * z.d
    updates = (x.w * y.w * z.w * sent).reshape(-1, 3, _WIDTH)
    nodes = jnp.zeros((st.num_nodes, _WIDTH), updates.dtype)
    nodes = jax.lax.scatter_add(nodes, st.rows.reshape(-1, 1), updates, _ADD_ROWS, mode=_IN_BOUNDS)
    return tuple(nodes[:, c].reshape(*st.batch[:-1], -1) for c in range(len(linear) - 9))


def gather_values(layout: Layout, residuals: Arrays, nodes: Arrays) -> Arrays:
    """(sum w g of all fields, sum w g d^T of the last three): transpose of ``scatter``; interpolation of velocities."""
    st, _ = _stencils(layout, residuals)
    return _values(_sums(st, nodes, VALUE_MOMENTS))


def gather_slopes(layout: Layout, residuals: Arrays, linear: Arrays) -> Arrays:
    """All ``SLOPE_MOMENTS`` of the node fields that follow x in residuals: 3 x 4 x 3 arrays."""
    del linear
    st, fields = _stencils(layout, residuals)
    names = sum(SLOPE_MOMENTS, ())
    sums = _sums(st, fields, names)
    return tuple(column for name in names for column in sums[name])


def scatter_tangent_transpose(layout: Layout, residuals: Arrays, cotangents: Arrays) -> Arrays:
    """Transpose of ``transfer_xla_cpu.scatter_tangent``."""
    st, rest = _stencils(layout, residuals)
    A, moved = as_matrix(rest[4:]), (".sww", ".wsw", ".wws")
    sums = _sums(st, cotangents, (*VALUE_MOMENTS, *moved), _message(rest[:4], A))
    values = _values(sums)
    work = cp.vector(lambda a: sum(sums[moved[a]]))
    return (*cp.subtract(work, cp.matvec(cp.transpose(A), as_vector(values[1:4]))), *values)


def gather_tangent(layout: Layout, residuals: Arrays, linear: Arrays) -> Arrays:
    """As ``transfer_xla_cpu.gather_tangent``."""
    return tangent_by_slopes(gather_slopes, gather_values, layout, residuals, linear)


def gather_tangent_transpose(layout: Layout, residuals: Arrays, cotangents: Arrays) -> Arrays:
    return cotangent_by_slopes(gather_slopes, scatter, layout, residuals, cotangents)


# --- Sums over the stencil -------------------------------------------------------------------------------------------


def _stencils(layout: Layout, residuals: Arrays) -> tuple[_Stencils, Arrays]:
    grid, (locations, rest) = layout.grid, split(layout, residuals)
    batch, dtype = locations[0].shape, locations[0].dtype
    lowest = [
        lowest_node(locations[a].reshape(-1), origin=grid.origin[a], spacing=grid.spacing, num_nodes=grid.shape[a])
        for a in cp.AXES
    ]
    rows = lowest_rows(layout, locations, lowest, env_of_particles(layout, batch))
    # Compute floor once; fused copies may round differently.
    stored = compute_once(jnp.concatenate([rows, jnp.stack(lowest)]))
    cells = jnp.stack([(locations[a].reshape(-1) - grid.origin[a]) * (1.0 / grid.spacing) for a in cp.AXES])
    fractions = compute_once(cells - stored[len(rows) :].astype(dtype))
    num_nodes = math.prod(batch[:-1]) * layout.num_nodes
    return _Stencils(stored[: len(rows)], fractions, grid.spacing, batch, num_nodes), rest


def _message(value: Sequence[Array], matrix: Mat3) -> list[Array]:
    """Three or four fields and their slopes along x, y, z, padded to four components each: 16 arrays (N,)."""
    zero = jnp.zeros_like(value[0])
    before = [zero] * (len(value) - 3)  # a mass has no slope
    fields = [value, *([*before, *(row[a] for row in matrix)] for a in cp.AXES)]
    return [a.reshape(-1) for field in fields for a in (*field, *[zero] * (_WIDTH - len(field)))]


def _apart(st: _Stencils, stored: Any) -> tuple[_Stencils, Any]:
    """Put both behind one barrier, so that XLA does not store the weights of 27 nodes for several kernels."""
    fractions, stored = compute_once((st.fractions, stored))
    return st._replace(fractions=fractions), stored


def _sums(
    st: _Stencils, fields: Arrays, names: tuple[str, ...], message: list[Array] | None = None
) -> dict[str, Arrays]:
    """Sums over the 27 nodes of node values times factors; the letters of a name select the factors.

    Summing axis by axis, as in ``transfer_xla_cpu``, takes fewer operations.

    Args:
      st: the particles' stencils.
      fields: fields of the nodes.
      names: see ``SLOPE_MOMENTS``. A leading dot multiplies by the momentum that the message sends to the node.
      message: result of ``_message``.

    Returns:
      For each name the sums of all fields, arrays of the particles' shape.
    """
    stored = [] if message is None else [jnp.stack(message)]
    st, (nodes, stored) = _apart(st, (jnp.concatenate([f.reshape(-1) for f in fields]), stored))
    sent = [m[i : i + _WIDTH] for m in stored for i in range(0, len(m), _WIDTH)]
    first = st.num_nodes * jnp.arange(len(fields), dtype=jnp.int32)[:, None]
    total: dict[str, Array] = {}
    for i in range(3):
        x, in_plane = _node(st, 0, i), {}
        sent_x = sent[0] + sent[1] * x.d if sent else None
        for j in range(3):
            y, in_column = _node(st, 1, j), {}
            sent_y = sent_x + sent[2] * y.d if sent else None
            for k in range(3):
                z, index = _node(st, 2, k), (st.rows[3 * i + j] + k) + first
                g = {"": jax.lax.gather(nodes, index[..., None], _TAKE, (1,), mode=_IN_BOUNDS)}
                if sent:
                    g["."] = g[""] * (sent_y + sent[3] * z.d)
                _add(in_column, names, 2, z, g)
            _add(in_plane, names, 1, y, in_column)
        _add(total, names, 0, x, in_plane)
    # Computed once: XLA would gather again for every component that is sliced out.
    total = compute_once(total)
    return {name: tuple(total[name][c].reshape(st.batch) for c in range(len(fields))) for name in names}


def _add(sums: dict[str, Array], names: tuple[str, ...], axis: int, node: _Axis, inner: dict[str, Array]) -> None:
    """Add the contribution of one node of this axis to the sums over this axis and the following ones."""
    wanted = dict.fromkeys(name[:-3] + name[-3 + axis :] for name in names)
    for name in wanted:
        mark, letters = name[: axis - 3], name[axis - 3 :]
        sums[name] = sums.get(name, 0.0) + _factor(node, letters[0]) * inner[mark + letters[1:]]


def _factor(axis: _Axis, letter: str) -> Array:
    return {"w": axis.w, "o": axis.w * axis.d, "s": axis.s, "t": axis.s * axis.d}[letter]


def _node(st: _Stencils, axis: int, node: int) -> _Axis:
    """Factors of one of the three nodes along an axis, arrays (N,)."""
    f, inverse = st.fractions[axis], 1.0 / st.spacing
    w = (0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2)[node]
    s = (-(1.5 - f) * inverse, -2.0 * (f - 1.0) * inverse, (f - 0.5) * inverse)[node]
    return _Axis(w, s, (node - f) * st.spacing)


def _any_node(st: _Stencils, axis: int, node: Array) -> _Axis:
    """``_node`` for an array of node numbers 0, 1, 2, without slopes."""
    f = st.fractions[axis][:, None, None]
    outer = jnp.where(node == 0, 1.5 - f, f - 0.5)
    w = jnp.where(node == 1, 0.75 - (f - 1.0) ** 2, 0.5 * outer * outer)
    return _Axis(w, jnp.zeros_like(f), (node.astype(f.dtype) - f) * st.spacing)


def _values(sums: dict[str, Arrays]) -> Arrays:
    """(sum w g of all fields, sum w g d^T of the last three) as flat components."""
    value, *first = (sums[name] for name in VALUE_MOMENTS)
    return (*value, *flat(cp.matrix(lambda c, a: first[a][-3:][c])))
