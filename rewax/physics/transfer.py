"""Particle-to-grid and grid-to-particle: the hot loop of the material point method.

Both transfers are linear in what they carry, and so is each one's derivative; their transposes are written by hand
as one pass over the particles. With g a node's cotangent, w its weight, d its offset from the particle and
s = p + A d what the particle sends there:

* reverse of particle-to-grid, one gather:  p' = sum w g,  A' = sum w g d^T,  x' = sum grad w (g . s) - A^T sum w g
* reverse of grid-to-particle (v, B), one scatter of w (v' + B' d) and one gather
  x' = sum grad w (g . (v' + B' d)) - B'^T v

Arrays come as separate components (see ``components``) and may carry leading batch axes: ``vmap`` flattens
environments and particles into one long particle axis over one long node axis, which suits XLA's scatter best.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import components as cp
from rewax.physics.components import Mat3, Vec3
from rewax.physics.grid import Grid
from rewax.physics.kernels import quadratic_bspline
from rewax.physics.linear_pass import Arrays, linear_pass
from rewax.physics.materialize import materialize
from rewax.types import Array

_IN_BOUNDS = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
_SCATTER_WINDOWS = jax.lax.ScatterDimensionNumbers(
    update_window_dims=(1,), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
)
_GATHER_WINDOWS = jax.lax.GatherDimensionNumbers(offset_dims=(0,), collapsed_slice_dims=(), start_index_map=(0,))


class GridFields(NamedTuple):
    """What particles leave on the nodes, as components of shape grid.shape."""

    mass: Array
    """Node mass [kg]."""
    momentum: Vec3
    """Node momentum [kg m/s]."""


class _Axis(NamedTuple):
    """``Stencil`` along one axis with its three nodes stacked, arrays (3, particles)."""

    weights: Array
    slopes: Array
    offsets: Array


class _Stencils(NamedTuple):
    """Where all particles of all copies of the grid meet the nodes."""

    base: Array
    """Flat index of each particle's lowest node, shape (particles,)."""
    axes: tuple[_Axis, ...]
    batch: tuple[int, ...]
    """Shape of the particle arrays before flattening."""
    num_copies: int
    """Product of the batch axes before the particles."""


class _Affine(NamedTuple):
    """Fields that vary linearly around each particle: value + slope . d, arrays of shape (num_fields, particles)."""

    value: Array
    slope: tuple[Array, Array, Array]


def particle_to_grid(grid: Grid, x: Vec3, mass: Array, momentum: Vec3, affine: Mat3) -> GridFields:
    """Spread particles' mass and momentum onto the nodes around them.

    Node i receives w_i mass and w_i (momentum + affine d_i), d_i its offset from the particle. Mass is conserved to
    rounding, momentum too, whatever the affine part.

    Args:
      grid: the nodes.
      x: particle positions [m], components of shape (num_particles,).
      mass: particle masses [kg], shape (num_particles,).
      momentum: particle momenta [kg m/s], components of shape (num_particles,).
      affine: linear field of momentum around each particle [kg/s]; in MLS-MPM -dt vol 4/dx^2 tau + mass C.

    Returns:
      Mass and momentum of the nodes, components of shape grid.shape.

    Gradient: exact with respect to all arrays, forward and reverse.
    Source: Hu et al. 2018, MLS-MPM, eq. 29; Jiang et al. 2015, APIC.
    """
    m, px, py, pz = _particle_to_grid(grid, *x, mass, *momentum, *affine[0], *affine[1], *affine[2])
    return GridFields(m, (px, py, pz))


def grid_to_particle(grid: Grid, x: Vec3, velocity: Vec3) -> tuple[Vec3, Mat3]:
    """Interpolate node velocities at particles, with their first moment.

    Args:
      grid: the nodes.
      x: particle positions [m], components of shape (num_particles,).
      velocity: node velocities [m/s], components of shape grid.shape.

    Returns:
      velocity: sum w_i v_i [m/s], components of shape (num_particles,).
      moment: B = sum w_i v_i d_i^T [m^2/s]; the velocity gradient is C = 4/dx^2 B.

    Gradient: exact with respect to positions and velocities, forward and reverse.
    Source: Jiang et al. 2015, APIC; Hu et al. 2018, MLS-MPM, eq. 17.
    """
    out = _grid_to_particle(grid, *x, *velocity)
    return _as_vector(out[:3]), _as_matrix(out[3:])


# --- The four passes -------------------------------------------------------------------------------------------------


def _spread(grid: Grid, residuals: Arrays, linear: Arrays) -> Arrays:
    """w (mass, p + A d) summed onto nodes. residuals: x; linear: mass, p, A. -> mass, momentum of the nodes."""
    st = _stencils(grid, residuals[:3])
    return _scatter(grid, st, _affine((linear[0], *linear[1:4]), _as_matrix(linear[4:])))


def _gather_moments(grid: Grid, residuals: Arrays, cotangents: Arrays) -> Arrays:
    """Transpose of ``_spread``: (sum w g_mass, sum w g, sum w g d^T)."""
    st = _stencils(grid, residuals[:3])
    q, B = _gather(grid, st, cotangents)
    return (*q, *_flat(B))


def _spread_tangent(grid: Grid, residuals: Arrays, linear: Arrays) -> Arrays:
    """Derivative of ``_spread`` in the direction (dx, dmass, dp, dA) at (x, mass, p, A)."""
    st = _stencils(grid, residuals[:3])
    mass, p, A = residuals[3], residuals[4:7], _as_matrix(residuals[7:])
    dx, dmass, dp, dA = _as_vector(linear[:3]), linear[3], _as_vector(linear[4:7]), _as_matrix(linear[7:])
    along = _affine((dmass, *cp.subtract(dp, cp.matvec(A, dx))), dA)
    return _scatter(grid, st, along, moved=(dx, _affine((mass, *p), A)))


def _spread_tangent_transpose(grid: Grid, residuals: Arrays, cotangents: Arrays) -> Arrays:
    st = _stencils(grid, residuals[:3])
    mass, p, A = residuals[3], residuals[4:7], _as_matrix(residuals[7:])
    q, B, X = _gather_both(grid, st, cotangents, _affine((mass, *p), A))
    dx = cp.subtract(X, cp.matvec(cp.transpose(A), _as_vector(q[1:])))
    return (*dx, *q, *_flat(B))


def _interpolate(grid: Grid, residuals: Arrays, linear: Arrays) -> Arrays:
    """(sum w g, sum w g d^T) of node velocities g. residuals: x; linear: velocity."""
    st = _stencils(grid, residuals[:3])
    q, B = _gather(grid, st, linear)
    return (*q, *_flat(B))


def _interpolate_transpose(grid: Grid, residuals: Arrays, cotangents: Arrays) -> Arrays:
    st = _stencils(grid, residuals[:3])
    v, B = cotangents[:3], _as_matrix(cotangents[3:])
    return _scatter(grid, st, _affine(v, B))


def _interpolate_tangent(grid: Grid, residuals: Arrays, linear: Arrays) -> Arrays:
    """Derivative of ``_interpolate`` in the direction (dx, dg) at (x, g, v = sum w g)."""
    x, g, v = residuals[:3], residuals[3:6], _as_vector(residuals[6:9])
    dx, dg = linear[:3], linear[3:]
    st = _stencils(grid, x)
    q, B = _gather(grid, st, dg)
    slope_q, slope_B = _gather_slope(grid, st, g, dx)
    dv = cp.add(_as_vector(q), _as_vector(slope_q))
    dB = cp.matrix(lambda i, j: B[i][j] + slope_B[i][j] - v[i] * dx[j])
    return (*dv, *_flat(dB))


def _interpolate_tangent_transpose(grid: Grid, residuals: Arrays, cotangents: Arrays) -> Arrays:
    x, g, v = residuals[:3], residuals[3:6], _as_vector(residuals[6:9])
    vbar, Bbar = cotangents[:3], _as_matrix(cotangents[3:])
    st = _stencils(grid, x)
    X = _gather_work(grid, st, g, _affine(vbar, Bbar))
    dx = cp.subtract(X, cp.matvec(cp.transpose(Bbar), v))
    return (*dx, *_interpolate_transpose(grid, x, cotangents))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _particle_to_grid(grid: Grid, *args: Array) -> Arrays:
    return linear_pass(_spread, _gather_moments, grid, args[:3], args[3:])


@_particle_to_grid.defjvp
def _particle_to_grid_jvp(grid: Grid, args: Arrays, tangents: Arrays) -> tuple[Arrays, Arrays]:
    out = _particle_to_grid(grid, *args)
    return out, linear_pass(_spread_tangent, _spread_tangent_transpose, grid, args, tangents)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _grid_to_particle(grid: Grid, *args: Array) -> Arrays:
    return linear_pass(_interpolate, _interpolate_transpose, grid, args[:3], args[3:])


@_grid_to_particle.defjvp
def _grid_to_particle_jvp(grid: Grid, args: Arrays, tangents: Arrays) -> tuple[Arrays, Arrays]:
    out = _grid_to_particle(grid, *args)
    residuals = (*args, *out[:3])
    return out, linear_pass(_interpolate_tangent, _interpolate_tangent_transpose, grid, residuals, tangents)


# --- Sums over the stencil -------------------------------------------------------------------------------------------


def _as_vector(a: Arrays) -> Vec3:
    return (a[0], a[1], a[2])


def _as_matrix(a: Arrays) -> Mat3:
    return (_as_vector(a[0:3]), _as_vector(a[3:6]), _as_vector(a[6:9]))


def _flat(a: Mat3) -> Arrays:
    return (*a[0], *a[1], *a[2])


def _stencils(grid: Grid, x: Arrays) -> _Stencils:
    """Stencils of all particles, flat index of the lowest node of each; batch axes are flattened away."""
    batch = x[0].shape
    axes, base = [], jnp.zeros((), jnp.int32)
    for a in cp.AXES:
        st = quadratic_bspline(x[a].reshape(-1), origin=grid.origin[a], spacing=grid.spacing, num_nodes=grid.shape[a])
        base = base + st.base * grid.strides[a]
        axes.append(_Axis(jnp.stack(st.weights), jnp.stack(st.slopes), jnp.stack(st.offsets)))
    copies = math.prod(batch[:-1])
    if copies > 1:
        base = base + np.repeat(np.arange(copies, dtype=np.int32) * grid.num_nodes, batch[-1])
    return _Stencils(base, tuple(materialize(axes)), batch, copies)


def _affine(value: Arrays, matrix: Mat3) -> _Affine:
    """Stack three or four fields; the last three have the matrix's rows as slopes, a mass before them has none."""
    extra = [jnp.zeros_like(matrix[0][0])] * (len(value) - 3)
    slopes = [_stack([*extra, *(row[a] for row in matrix)]) for a in cp.AXES]
    return _Affine(_stack(value), (slopes[0], slopes[1], slopes[2]))


def _stack(arrays) -> Array:
    """Shape (len(arrays), particles). The barrier keeps XLA from recomputing the stack in every one of its users."""
    return materialize(jnp.stack(materialize([a.reshape(-1) for a in arrays])))


def _scatter(grid: Grid, st: _Stencils, field: _Affine, moved: tuple[Arrays, _Affine] | None = None) -> Arrays:
    """Sum w (value + slope . d) onto the 27 nodes around each particle, one window of 3 nodes along z at a time.

    ``moved = (dx, other)`` adds the change of the weights, (grad w . dx) (other.value + other.slope . d).
    """
    count = field.value.shape[0]
    x_axis, y_axis, z_axis = st.axes
    num_values = grid.num_nodes * st.num_copies * count
    change = None if moved is None else [a.reshape(-1) for a in moved[0]]

    def window(f: _Affine, x: _Axis, y: _Axis) -> Array:
        plane = f.value + f.slope[0] * x.offsets + f.slope[1] * y.offsets
        return plane[None] + z_axis.offsets[:, None] * f.slope[2][None]

    def add(n: Array, nodes: Array) -> Array:
        i, j = n // 3, n % 3
        x, y = _node(x_axis, i), _node(y_axis, j)
        updates = (x.weights * y.weights * z_axis.weights)[:, None] * window(field, x, y)
        if moved is not None and change is not None:
            across = change[0] * x.slopes * y.weights + change[1] * x.weights * y.slopes
            slope = across * z_axis.weights + change[2] * x.weights * y.weights * z_axis.slopes
            updates = updates + slope[:, None] * window(moved[1], x, y)
        updates = materialize(updates).reshape(3 * count, -1).T
        start = (st.base + i * grid.strides[0] + j * grid.strides[1]) * count
        return jax.lax.scatter_add(nodes, start[:, None], updates, _SCATTER_WINDOWS, mode=_IN_BOUNDS)

    nodes = jax.lax.fori_loop(0, 9, add, jnp.zeros((num_values,), field.value.dtype))
    fields = nodes.reshape(-1, count).T.reshape(count, *st.batch[:-1], *grid.shape)
    return tuple(fields[c] for c in range(count))


def _node(axis: _Axis, i: Array) -> _Axis:
    """One of the three nodes along an axis, arrays (particles,), stored: a slice inside a fusion is not vectorised."""
    return materialize(_Axis(axis.weights[i], axis.slopes[i], axis.offsets[i]))


class _Moments(NamedTuple):
    """Sums over the stencil of node values g."""

    total: Array
    """sum w g, shape (num_fields, particles)."""
    first: tuple[Array, Array, Array]
    """sum w g d by component of d, each (3, particles), of the last three fields."""


def _windows(grid: Grid, st: _Stencils, fields: Arrays, add, init):
    """Fold ``add(x, y, g, carry)`` over the 9 windows; g: three arrays (num_fields, particles), nodes along z."""
    count = len(fields)
    rows = jnp.stack(materialize(fields), axis=-1).reshape(-1)

    def body(n: Array, carry):
        i, j = n // 3, n % 3
        start = (st.base + i * grid.strides[0] + j * grid.strides[1]) * count
        window = jax.lax.gather(rows, start[:, None], _GATHER_WINDOWS, (3 * count,), mode=_IN_BOUNDS)
        columns = window.reshape(3, count, -1)
        x, y = _node(st.axes[0], i), _node(st.axes[1], j)
        return add(x, y, (columns[0], columns[1], columns[2]), carry)

    return jax.lax.fori_loop(0, 9, body, init)


def _gather(grid: Grid, st: _Stencils, fields: Arrays) -> tuple[Arrays, Mat3]:
    """q = sum w g of all fields, B = sum w g d^T of the last three (a mass may come before them)."""
    moments = _windows(grid, st, fields, functools.partial(_add_moments, st), _zero_moments(st, fields))
    return _unpack_moments(st, moments)


def _gather_work(grid: Grid, st: _Stencils, fields: Arrays, source: _Affine) -> Vec3:
    """X = sum grad w (g . (value + slope . d)): how the work done on the nodes changes with the particle's position."""
    X = _windows(grid, st, fields, functools.partial(_add_work, st, source), _zero_work(st, fields))
    return cp.vector(lambda a: X[a].reshape(st.batch))


def _gather_both(grid: Grid, st: _Stencils, fields: Arrays, source: _Affine) -> tuple[Arrays, Mat3, Vec3]:
    """``_gather`` and ``_gather_work`` in one pass."""

    def add(x: _Axis, y: _Axis, g, carry):
        return _add_moments(st, x, y, g, carry[0]), _add_work(st, source, x, y, g, carry[1])

    moments, X = _windows(grid, st, fields, add, (_zero_moments(st, fields), _zero_work(st, fields)))
    q, B = _unpack_moments(st, moments)
    return q, B, cp.vector(lambda a: X[a].reshape(st.batch))


def _add_moments(st: _Stencils, x: _Axis, y: _Axis, g, m: _Moments) -> _Moments:
    z_axis = st.axes[2]
    skip = g[0].shape[0] - 3
    wz, wdz = z_axis.weights, z_axis.weights * z_axis.offsets
    wij = x.weights * y.weights
    a = wij * (wz[0] * g[0] + wz[1] * g[1] + wz[2] * g[2])
    b = wij * (wdz[0] * g[0] + wdz[1] * g[1] + wdz[2] * g[2])[skip:]
    bx, by, bz = m.first
    return _Moments(m.total + a, (bx + x.offsets * a[skip:], by + y.offsets * a[skip:], bz + b))


def _add_work(st: _Stencils, source: _Affine, x: _Axis, y: _Axis, g, X: Vec3) -> Vec3:
    z_axis = st.axes[2]
    plane = source.value + source.slope[0] * x.offsets + source.slope[1] * y.offsets
    work = []
    for k in cp.AXES:
        terms = g[k] * (plane + source.slope[2] * z_axis.offsets[k])
        work.append(sum(terms[c] for c in range(terms.shape[0])))
    work = materialize(work)
    along = z_axis.weights[0] * work[0] + z_axis.weights[1] * work[1] + z_axis.weights[2] * work[2]
    across = z_axis.slopes[0] * work[0] + z_axis.slopes[1] * work[1] + z_axis.slopes[2] * work[2]
    return (
        X[0] + x.slopes * y.weights * along,
        X[1] + x.weights * y.slopes * along,
        X[2] + x.weights * y.weights * across,
    )


def _zero_moments(st: _Stencils, fields: Arrays) -> _Moments:
    zeros = jnp.zeros((len(fields), st.base.shape[0]), fields[0].dtype)
    return _Moments(zeros, (zeros[:3], zeros[:3], zeros[:3]))


def _zero_work(st: _Stencils, fields: Arrays) -> Vec3:
    zeros = jnp.zeros(st.base.shape, fields[0].dtype)
    return (zeros, zeros, zeros)


def _unpack_moments(st: _Stencils, m: _Moments) -> tuple[Arrays, Mat3]:
    return _unstack(st, m.total), cp.matrix(lambda c, a: m.first[a][c].reshape(st.batch))


def _gather_slope(grid: Grid, st: _Stencils, fields: Arrays, dx: Arrays) -> tuple[Arrays, Mat3]:
    """(sum (grad w . dx) g, sum (grad w . dx) g d^T) of three fields: only forward mode needs it."""
    z_axis = st.axes[2]
    change = [a.reshape(-1) for a in dx]

    def add(x: _Axis, y: _Axis, g, m: _Moments) -> _Moments:
        across = change[0] * x.slopes * y.weights + change[1] * x.weights * y.slopes
        slope = across * z_axis.weights + change[2] * x.weights * y.weights * z_axis.slopes
        a = slope[0] * g[0] + slope[1] * g[1] + slope[2] * g[2]
        moved = slope * z_axis.offsets
        b = moved[0] * g[0] + moved[1] * g[1] + moved[2] * g[2]
        bx, by, bz = m.first
        return _Moments(m.total + a, (bx + x.offsets * a, by + y.offsets * a, bz + b))

    return _unpack_moments(st, _windows(grid, st, fields, add, _zero_moments(st, fields)))


def _unstack(st: _Stencils, a: Array) -> Arrays:
    return tuple(a[c].reshape(st.batch) for c in range(a.shape[0]))
