"""The transfers for CPUs in JAX: long arrays with one number per particle, contracted axis by axis.

Every sum over the 27 nodes is separable: w, d w, grad w and d grad w are products of factors along x, y and z. Arrays
may have leading batch axes. They are flattened: environments and particles into one particle axis, their nodes into one
node axis.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.fusion import materialize
from rewax.lowering.linear_primitive import Arrays, Rule
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.splines import quadratic_bspline
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Mat3, Vec3
from rewax.types import Array

_IN_BOUNDS = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
_SCATTER_ROWS = jax.lax.ScatterDimensionNumbers(
    update_window_dims=(1,), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
)
_MAX_FIELDS = 4
"""Largest number of fields on the nodes: mass and momentum."""
_COLUMNS = np.asarray([[i, j] for i in range(3) for j in range(3)], np.int32)
"""Offsets along x and y of the 9 columns along z that a particle touches."""
_GATHER_ROWS = jax.lax.GatherDimensionNumbers(offset_dims=(1,), collapsed_slice_dims=(), start_index_map=(0,))


class Axis(NamedTuple):
    """Factors along one axis for its three nodes, arrays (3, particles), named by the letters of moments."""

    w: Array
    """Weight [-]."""
    o: Array
    """Weight times offset of the node [m]."""
    s: Array
    """Slope of the weight [1/m]."""
    t: Array
    """Slope of the weight times offset of the node [-]."""
    offset: Array
    """Node position minus particle position [m]."""


class Layout(NamedTuple):
    """Static sizes of a transfer."""

    grid: Grid
    num_active: int | None
    """Length of node arrays that hold active nodes only; None: they hold all nodes."""

    @property
    def num_nodes(self) -> int:
        return self.grid.num_nodes if self.num_active is None else self.num_active

    @property
    def num_locations(self) -> int:
        """Number of location arrays: x, y, z and, with active nodes, the offsets of columns."""
        return 3 if self.num_active is None else 4


class Stencils(NamedTuple):
    """Node indices and weights of all particles of all environments."""

    rows: Array
    """Index of the lowest node of each of the 9 rows of 3 nodes along z that a particle touches, among the nodes of all
    environments, shape (9, particles), int32."""
    axes: tuple[Axis, Axis, Axis]
    batch: tuple[int, ...]
    """Shape of the particle arrays before flattening."""

    @property
    def num_envs(self) -> int:
        return math.prod(self.batch[:-1])


class Affine(NamedTuple):
    """Fields that vary linearly around each particle: value + slope . d, arrays of shape (num_fields, particles)."""

    value: Array
    slope: tuple[Array, Array, Array]


class Term(NamedTuple):
    """A contribution of particles to a node: the product of three factors, one per axis, times an affine field."""

    factors: tuple[Array, Array, Array]
    field: Affine


VALUE_MOMENTS = ("www", "oww", "wow", "wwo")
"""Sums over the stencil of w g, and of w g times the offset along x, y, z: one letter of ``Axis`` per axis."""
SLOPE_MOMENTS = (("sww", "tww", "sow", "swo"), ("wsw", "osw", "wtw", "wso"), ("wws", "ows", "wos", "wwt"))
"""Derivatives of ``VALUE_MOMENTS`` by the particle's position along x, y, z at constant offsets."""


def scatter(layout: Layout, residuals: Arrays, linear: Arrays) -> Arrays:
    """Sum w (mass, p + A d) onto nodes. residuals: locations; linear: mass (or none), p, A."""
    st, _ = stencils(layout, residuals)
    return _scatter_terms(layout, st, [Term(_weights(st), _affine(linear[:-9], as_matrix(linear[-9:])))])


def gather_values(layout: Layout, residuals: Arrays, nodes: Arrays) -> Arrays:
    """(sum w g of all fields, sum w g d^T of the last three): transpose of ``scatter``; interpolation of velocities."""
    st, _ = stencils(layout, residuals)
    return _values(st, _moments(st, nodes, VALUE_MOMENTS))


def gather_slopes(layout: Layout, residuals: Arrays, linear: Arrays) -> Arrays:
    """All ``SLOPE_MOMENTS`` of the node fields that follow x in residuals: 3 x 4 x 3 arrays."""
    del linear
    st, rest = stencils(layout, residuals)
    moments = _moments(st, rest, sum(SLOPE_MOMENTS, ()))
    return tuple(a for name in sum(SLOPE_MOMENTS, ()) for a in _unstack(st, moments[name]))


def scatter_tangent(layout: Layout, residuals: Arrays, linear: Arrays) -> Arrays:
    """Derivative of ``scatter`` in the direction (dx, dmass, dp, dA) at (x, mass, p, A)."""
    st, rest = stencils(layout, residuals)
    mass, p, A = rest[0], rest[1:4], as_matrix(rest[4:])
    dx, dmass, dp, dA = as_vector(linear[:3]), linear[3], as_vector(linear[4:7]), as_matrix(linear[7:])
    terms = [Term(_weights(st), _affine((dmass, *cp.subtract(dp, cp.matvec(A, dx))), dA))]
    field = _affine((mass, *p), A)
    for axis in cp.AXES:
        factors = [a.s * dx[axis].reshape(-1) if i == axis else a.w for i, a in enumerate(st.axes)]
        terms.append(Term(as_vector(factors), field))
    return _scatter_terms(layout, st, terms)


def scatter_tangent_transpose(layout: Layout, residuals: Arrays, cotangents: Arrays) -> Arrays:
    st, rest = stencils(layout, residuals)
    A = as_matrix(rest[4:])
    field = _affine(rest[:4], A)
    moments = _moments(st, cotangents, VALUE_MOMENTS + sum(SLOPE_MOMENTS, ()))
    values = _values(st, moments)
    work = cp.vector(lambda a: _work(st, field, [moments[name] for name in SLOPE_MOMENTS[a]]))
    return (*cp.subtract(work, cp.matvec(cp.transpose(A), as_vector(values[1:4]))), *values)


def gather_tangent(layout: Layout, residuals: Arrays, linear: Arrays) -> Arrays:
    """Derivative of interpolation, ``gather_values`` of three fields, in the direction (dx, dg) at (x, g).

    residuals: locations, g, and the values sum w g.
    """
    return tangent_by_slopes(gather_slopes, gather_values, layout, residuals, linear)


def gather_tangent_transpose(layout: Layout, residuals: Arrays, cotangents: Arrays) -> Arrays:
    return cotangent_by_slopes(gather_slopes, scatter, layout, residuals, cotangents)


# --- Sums over the stencil -------------------------------------------------------------------------------------------


def tangent_by_slopes(slopes_of: Rule, values_of: Rule, layout: Layout, residuals: Arrays, linear: Arrays) -> Arrays:
    """``gather_tangent``, composed of ``gather_slopes`` and ``gather_values``."""
    (locations, rest), dx, dg = split(layout, residuals), linear[:3], linear[3:]
    slopes, value = slopes_of(layout, (*locations, *rest[:3]), ()), rest[3:]
    by_nodes = values_of(layout, locations, dg)

    def along(moment: int, component: int) -> Array:
        """Change of one moment of one component with the motion dx."""
        return sum(slopes[12 * a + 3 * moment + component] * dx[a] for a in cp.AXES)  # type: ignore[return-value]

    dv = cp.vector(lambda c: by_nodes[c] + along(0, c))
    dB = cp.matrix(lambda c, b: by_nodes[3 + 3 * c + b] + along(1 + b, c) - value[c] * dx[b])
    return (*dv, *flat(dB))


def cotangent_by_slopes(
    slopes_of: Rule, scatter: Rule, layout: Layout, residuals: Arrays, cotangents: Arrays
) -> Arrays:
    """``gather_tangent_transpose``, composed of ``gather_slopes`` and ``scatter``."""
    (locations, rest), v, B = split(layout, residuals), cotangents[:3], as_matrix(cotangents[3:])
    slopes, value = slopes_of(layout, (*locations, *rest[:3]), ()), rest[3:]

    def work(a: int) -> Array:
        terms = [slopes[12 * a + c] * v[c] for c in cp.AXES]
        terms += [slopes[12 * a + 3 + 3 * b + c] * B[c][b] for b in cp.AXES for c in cp.AXES]
        return sum(terms[1:], terms[0]) - sum(value[c] * B[c][a] for c in cp.AXES)

    return (*cp.vector(work), *scatter(layout, locations, cotangents))


def split(layout: Layout, args: Arrays) -> tuple[Arrays, Arrays]:
    return args[: layout.num_locations], args[layout.num_locations :]


def as_vector(a: Sequence[Array]) -> Vec3:
    return (a[0], a[1], a[2])


def as_matrix(a: Arrays) -> Mat3:
    return (as_vector(a[0:3]), as_vector(a[3:6]), as_vector(a[6:9]))


def flat(a: Mat3) -> Arrays:
    return (*a[0], *a[1], *a[2])


def stencils(layout: Layout, residuals: Arrays) -> tuple[Stencils, Arrays]:
    """Stencils of all particles, and the residuals that are no locations.

    Batch axes are flattened: the nodes of all environments form one axis.
    """
    grid = layout.grid
    locations, rest = split(layout, residuals)
    batch = locations[0].shape
    env = env_of_particles(layout, batch)
    axes, lowest = [], []
    for a in cp.AXES:
        x = locations[a].reshape(-1)
        st = quadratic_bspline(x, origin=grid.origin[a], spacing=grid.spacing, num_nodes=grid.shape[a])
        st, env = materialize((st, env)) if a == 0 and math.prod(batch[:-1]) > 1 else (materialize(st), env)
        w, s, d = jnp.stack(st.weights), jnp.stack(st.slopes), jnp.stack(st.offsets)
        axes.append(Axis(w, w * d, s, s * d, d))
        lowest.append(st.base)
    rows, axes = materialize((lowest_rows(layout, locations, lowest, env), tuple(axes)))
    return Stencils(rows, axes, batch), rest


def env_of_particles(layout: Layout, batch: tuple[int, ...]) -> Array:
    """Environment of each particle, shape (particles,), int32.

    The program computes it: a constant would be as long as all particles.

    Raises:
      ValueError: indices of the nodes of all environments do not fit into int32.
    """
    num_envs = math.prod(batch[:-1])
    check_size(layout, num_envs)
    return jax.lax.broadcasted_iota(jnp.int32, (num_envs, batch[-1]), 0).reshape(-1)


def lowest_rows(layout: Layout, locations: Arrays, lowest: Sequence[Array], env: Array) -> Array:
    """``Stencils.rows`` of particles with these lowest nodes along x, y and z."""
    grid = layout.grid
    columns = lowest[0] * grid.shape[1] + lowest[1] + (_COLUMNS @ np.asarray([[grid.shape[1]], [1]], np.int32))
    if layout.num_active is None:
        rows = columns * grid.shape[2] + lowest[2]
    else:
        table = locations[3].reshape(-1)
        columns = materialize(columns + env * grid.num_columns)
        rows = table.at[columns].get(mode="promise_in_bounds") + lowest[2]
        rows = jnp.clip(rows, 0, layout.num_nodes - 3)  # particles that left the active nodes: Status.INACTIVE_NODES
    return rows + env * layout.num_nodes


def check_size(layout: Layout, num_envs: int) -> None:
    """Raises ValueError if flat indices of the nodes' values do not fit into int32."""
    largest = num_envs * max(_MAX_FIELDS * layout.num_nodes, layout.grid.num_columns)
    if largest > np.iinfo(np.int32).max:
        most = np.iinfo(np.int32).max // (largest // num_envs)
        raise ValueError(
            f"{num_envs} environments of {layout.num_nodes} nodes are stepped at once, but int32 indices hold "
            f"{most} environments of that size: step fewer at once, with jax.lax.map over groups of them, or give the "
            "scene max_active_nodes"
        )


def _weights(st: Stencils) -> tuple[Array, Array, Array]:
    return (st.axes[0].w, st.axes[1].w, st.axes[2].w)


def _affine(value: Sequence[Array], matrix: Mat3) -> Affine:
    """Stack three or four fields. The last three have the matrix's rows as slopes; a mass has slope zero."""
    extra = [jnp.zeros_like(matrix[0][0])] * (len(value) - 3)
    slopes = [_stack([*extra, *(row[a] for row in matrix)]) for a in cp.AXES]
    return Affine(_stack(value), (slopes[0], slopes[1], slopes[2]))


def _stack(arrays: Sequence[Array]) -> Array:
    """Shape (len(arrays), particles). The barrier keeps XLA from recomputing the stack in every user."""
    return materialize(jnp.stack(materialize([a.reshape(-1) for a in arrays])))


def _unstack(st: Stencils, a: Array) -> Arrays:
    return tuple(a[c].reshape(st.batch) for c in range(a.shape[0]))


def _scatter_terms(layout: Layout, st: Stencils, terms: list[Term]) -> Arrays:
    """Scatter-add the terms to the 27 nodes around each particle, as 9 rows of 3 nodes along z."""
    count, num = terms[0].field.value.shape
    d = [axis.offset for axis in st.axes]
    sums = []
    for (wx, wy, wz), field in terms:
        across = (wx[:, None] * wy[None])[:, :, None]  # (3, 3, 1, particles)
        plane = field.value + field.slope[0] * d[0][:, None, None] + field.slope[1] * d[1][None, :, None]
        plane, tilt, lever = materialize((across * plane, across * field.slope[2], wz * d[2]))
        sums.append(wz[:, None] * plane[:, :, None] + lever[:, None] * tilt[:, :, None])
    updates = sum(sums[1:], sums[0])  # (3, 3, 3, count, particles)
    rows = materialize(updates.reshape(9, 3 * count, num))
    rows = materialize(rows.transpose(0, 2, 1)).reshape(9 * num, 3 * count)
    start = materialize(st.rows * count).reshape(-1, 1)
    nodes = jnp.zeros((st.num_envs * layout.num_nodes * count,), rows.dtype)
    nodes = jax.lax.scatter_add(nodes, start, rows, _SCATTER_ROWS, mode=_IN_BOUNDS)
    fields = materialize(nodes.reshape(-1, count)).T.reshape(count, *st.batch[:-1], -1)
    return tuple(fields[c] for c in range(count))


def _moments(st: Stencils, fields: Arrays, names: tuple[str, ...]) -> dict[str, Array]:
    """Sums over the stencil of g times one factor per axis, each (num_fields, particles)."""
    count, num = len(fields), st.rows.shape[1]
    nodes = materialize(jnp.stack(materialize([f.reshape(-1) for f in fields]), axis=-1)).reshape(-1)
    start = materialize(st.rows * count).reshape(-1, 1)
    rows = jax.lax.gather(nodes, start, _GATHER_ROWS, (3 * count,), mode=_IN_BOUNDS)
    rows = materialize(rows.reshape(9, num, 3 * count))
    g = materialize(rows.transpose(0, 2, 1)).reshape(3, 3, 3, count, num)
    along_z = {z: _contract(getattr(st.axes[2], z), g) for z in dict.fromkeys(n[2] for n in names)}
    along_z = materialize(along_z)
    along_y = {yz: _contract(getattr(st.axes[1], yz[0]), along_z[yz[1]]) for yz in dict.fromkeys(n[1:] for n in names)}
    along_y = materialize(along_y)
    return materialize({n: _contract(getattr(st.axes[0], n[0]), along_y[n[1:]]) for n in names})


def _contract(factor: Array, g: Array) -> Array:
    """Sum over the last of the node axes of g (..., 3, num_fields, particles), factor (3, particles)."""
    return g[..., 0, :, :] * factor[0] + g[..., 1, :, :] * factor[1] + g[..., 2, :, :] * factor[2]


def _values(st: Stencils, moments: dict[str, Array]) -> Arrays:
    """(sum w g of all fields, sum w g d^T of the last three) as flat components."""
    q = _unstack(st, moments["www"])
    first = [_unstack(st, moments[name])[-3:] for name in VALUE_MOMENTS[1:]]
    return (*q, *flat(cp.matrix(lambda c, a: first[a][c])))


def _work(st: Stencils, field: Affine, slopes: list[Array]) -> Array:
    """sum grad w (g . (value + slope . d)) along one axis, from that axis' ``SLOPE_MOMENTS``."""
    terms = [field.value * slopes[0], *(field.slope[b] * slopes[1 + b] for b in cp.AXES)]
    terms = materialize(terms[0] + terms[1] + terms[2] + terms[3])
    return sum(_unstack(st, terms)[1:], _unstack(st, terms)[0])
