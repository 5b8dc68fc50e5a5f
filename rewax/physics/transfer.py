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
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import components as cp
from rewax.physics.materialize import materialize
from rewax.physics.components import Mat3, Vec3
from rewax.physics.grid import Grid
from rewax.physics.kernels import Stencil, quadratic_bspline
from rewax.physics.linear_pass import Arrays, linear_pass
from rewax.types import Array

_IN_BOUNDS = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
_SCATTER_WINDOWS = jax.lax.ScatterDimensionNumbers(
    update_window_dims=(1,), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
)
_GATHER_WINDOWS = jax.lax.GatherDimensionNumbers(offset_dims=(1,), collapsed_slice_dims=(), start_index_map=(0,))


class GridFields(NamedTuple):
    """What particles leave on the nodes, as components of shape grid.shape."""

    mass: Array
    """Node mass [kg]."""
    momentum: Vec3
    """Node momentum [kg m/s]."""


class _Stencils(NamedTuple):
    base: Array
    axes: tuple[Stencil, Stencil, Stencil]


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
    return out[:3], _as_matrix(out[3:])


# --- The four passes -------------------------------------------------------------------------------------------------


def _spread(grid: Grid, residuals: Arrays, linear: Arrays) -> Arrays:
    """w (mass, p + A d) summed onto nodes. residuals: x; linear: mass, p, A. -> mass, momentum of the nodes."""
    st = _stencils(grid, residuals[:3])
    return _scatter(grid, st, _affine((linear[0], *linear[1:4]), _as_matrix(linear[4:])))


def _gather_moments(grid: Grid, residuals: Arrays, cotangents: Arrays) -> Arrays:
    """Transpose of ``_spread``: (sum w g_mass, sum w g, sum w g d^T)."""
    st = _stencils(grid, residuals[:3])
    q, B, _ = _gather(grid, st, cotangents, None)
    return (*q, *_flat(B))


def _spread_tangent(grid: Grid, residuals: Arrays, linear: Arrays) -> Arrays:
    """Derivative of ``_spread`` in the direction (dx, dmass, dp, dA) at (x, mass, p, A)."""
    st = _stencils(grid, residuals[:3])
    mass, p, A = residuals[3], residuals[4:7], _as_matrix(residuals[7:])
    dx, dmass, dp, dA = linear[:3], linear[3], linear[4:7], _as_matrix(linear[7:])
    along = _affine((dmass, *cp.subtract(dp, cp.matvec(A, dx))), dA)
    return _scatter(grid, st, along, moved=(dx, _affine((mass, *p), A)))


def _spread_tangent_transpose(grid: Grid, residuals: Arrays, cotangents: Arrays) -> Arrays:
    st = _stencils(grid, residuals[:3])
    mass, p, A = residuals[3], residuals[4:7], _as_matrix(residuals[7:])
    q, B, X = _gather(grid, st, cotangents, (mass, p, A))
    dx = cp.subtract(X, cp.matvec(cp.transpose(A), q[1:]))
    return (*dx, *q, *_flat(B))


def _interpolate(grid: Grid, residuals: Arrays, linear: Arrays) -> Arrays:
    """(sum w g, sum w g d^T) of node velocities g. residuals: x; linear: velocity."""
    st = _stencils(grid, residuals[:3])
    q, B, _ = _gather(grid, st, linear, None)
    return (*q, *_flat(B))


def _interpolate_transpose(grid: Grid, residuals: Arrays, cotangents: Arrays) -> Arrays:
    st = _stencils(grid, residuals[:3])
    v, B = cotangents[:3], _as_matrix(cotangents[3:])
    return _scatter(grid, st, _affine(v, B))


def _interpolate_tangent(grid: Grid, residuals: Arrays, linear: Arrays) -> Arrays:
    """Derivative of ``_interpolate`` in the direction (dx, dg) at (x, g, v = sum w g)."""
    x, g, v = residuals[:3], residuals[3:6], residuals[6:9]
    dx, dg = linear[:3], linear[3:]
    st = _stencils(grid, x)
    q, B, _ = _gather(grid, st, dg, None)
    slope_q, slope_B = _gather_slope(grid, st, g, dx)
    dv = cp.add(q, slope_q)
    dB = cp.matrix(lambda i, j: B[i][j] + slope_B[i][j] - v[i] * dx[j])
    return (*dv, *_flat(dB))


def _interpolate_tangent_transpose(grid: Grid, residuals: Arrays, cotangents: Arrays) -> Arrays:
    x, g, v = residuals[:3], residuals[3:6], residuals[6:9]
    vbar, Bbar = cotangents[:3], _as_matrix(cotangents[3:])
    st = _stencils(grid, x)
    _, _, X = _gather(grid, st, g, (None, vbar, Bbar), moments=False)
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


def _as_matrix(a: Arrays) -> Mat3:
    return (a[0:3], a[3:6], a[6:9])  # type: ignore[return-value]


def _flat(a: Mat3) -> Arrays:
    return (*a[0], *a[1], *a[2])


def _stencils(grid: Grid, x: Arrays) -> _Stencils:
    """Stencils of all particles, flat index of the lowest node of each; batch axes are flattened away."""
    axes = tuple(
        quadratic_bspline(x[a], origin=grid.origin[a], spacing=grid.spacing, num_nodes=grid.shape[a]) for a in cp.AXES
    )
    base = sum(st.base * stride for st, stride in zip(axes, grid.strides, strict=True))
    batch = x[0].shape[:-1]
    if batch:
        env = np.arange(np.prod(batch), dtype=np.int32).reshape(*batch, 1) * grid.num_nodes
        base = base + env
    return _Stencils(base.reshape(-1), axes)  # type: ignore[arg-type]


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
    sx, sy, sz = st.axes
    shape, count = sx.base.shape, field.value.shape[0]
    x_axis, y_axis = _flatten(sx), _flatten(sy)
    wz, mz, dz = _stack(sz.weights), _stack(sz.slopes), _stack(sz.offsets)

    def window(f: _Affine, i: int, j: int) -> Array:
        plane = f.value + f.slope[0] * x_axis.offsets[i] + f.slope[1] * y_axis.offsets[j]
        return plane[None] + dz[:, None] * f.slope[2][None]

    num_values = grid.num_nodes * int(np.prod(shape[:-1])) * count
    nodes = jnp.zeros((num_values,), field.value.dtype)
    for i, j in itertools.product(cp.AXES, repeat=2):
        wx, wy = x_axis.weights[i], y_axis.weights[j]
        updates = (wx * wy * wz)[:, None] * window(field, i, j)
        if moved is not None:
            dx, dy, dzz = (a.reshape(-1) for a in moved[0])
            slope = (dx * x_axis.slopes[i] * wy + dy * wx * y_axis.slopes[j]) * wz + dzz * wx * wy * mz
            updates = updates + slope[:, None] * window(moved[1], i, j)
        updates = materialize(updates).reshape(3 * count, -1).T
        start = (st.base + int(np.dot((i, j, 0), grid.strides))) * count
        nodes = jax.lax.scatter_add(nodes, start[:, None], updates, _SCATTER_WINDOWS, mode=_IN_BOUNDS)
    fields = nodes.reshape(-1, count).T.reshape(count, *shape[:-1], *grid.shape)
    return tuple(fields[c] for c in range(count))


def _flatten(stencil: Stencil) -> Stencil:
    return jax.tree.map(lambda a: a.reshape(-1), stencil)


def _windows(grid: Grid, st: _Stencils, fields: Arrays):
    """Values of all fields at three neighbouring nodes along z: for each (i, j) a list over k of field tuples."""
    shape, count = st.axes[0].base.shape, len(fields)
    rows = jnp.stack(materialize(fields), axis=-1).reshape(-1)
    for i, j in itertools.product(cp.AXES, repeat=2):
        start = (st.base + int(np.dot((i, j, 0), grid.strides))) * count
        window = jax.lax.gather(rows, start[:, None], _GATHER_WINDOWS, (3 * count,), mode=_IN_BOUNDS)
        columns = window.T.reshape(3, count, *shape)
        yield i, j, [tuple(columns[k, c] for c in range(count)) for k in cp.AXES]


def _gather(grid: Grid, st: _Stencils, fields: Arrays, source, *, moments: bool = True):
    """Sums over the stencil of node values g (one, three or four fields; of four the first is a mass).

    Args:
      source: None, or (mass or None, p, A): then also X = sum grad w (g . (mass, p + A d)).
      moments: whether q = sum w g and B = sum w g d^T are wanted.

    Returns:
      q: tuple over fields; B: Mat3 over the last three fields; X: Vec3 (zeros stand for what was not asked).
    """
    sx, sy, sz = st.axes
    count = len(fields)
    first = count - 3
    zero = jnp.zeros_like(sx.weights[0])
    q = [zero] * count
    B = [[zero] * 3 for _ in cp.AXES]
    X = [zero] * 3
    for i, j, g in _windows(grid, st, fields):
        wij = sx.weights[i] * sy.weights[j]
        if moments:
            wd = [w * d for w, d in zip(sz.weights, sz.offsets, strict=True)]
            a = [sum(sz.weights[k] * g[k][c] for k in cp.AXES) for c in range(count)]
            for c in range(count):
                q[c] = q[c] + wij * a[c]
            for c in cp.AXES:
                b = wd[0] * g[0][first + c] + wd[1] * g[1][first + c] + wd[2] * g[2][first + c]
                B[c][0] = B[c][0] + (wij * sx.offsets[i]) * a[first + c]
                B[c][1] = B[c][1] + (wij * sy.offsets[j]) * a[first + c]
                B[c][2] = B[c][2] + wij * b
        if source is not None:
            mass, p, A = source
            s = [p[c] + A[c][0] * sx.offsets[i] + A[c][1] * sy.offsets[j] for c in cp.AXES]
            work = []
            for k in cp.AXES:
                e = sum(g[k][first + c] * (s[c] + A[c][2] * sz.offsets[k]) for c in cp.AXES)
                work.append(e if mass is None else e + mass * g[k][0])
            along = sum(sz.weights[k] * work[k] for k in cp.AXES)
            X[0] = X[0] + sx.slopes[i] * sy.weights[j] * along
            X[1] = X[1] + sx.weights[i] * sy.slopes[j] * along
            X[2] = X[2] + wij * sum(sz.slopes[k] * work[k] for k in cp.AXES)
    return tuple(q), tuple(tuple(r) for r in B), tuple(X)


def _gather_slope(grid: Grid, st: _Stencils, fields: Arrays, dx: Arrays) -> tuple[Vec3, Mat3]:
    """(sum (grad w . dx) g, sum (grad w . dx) g d^T) of three fields: only forward mode needs it."""
    sx, sy, sz = st.axes
    zero = jnp.zeros_like(sx.weights[0])
    q = [zero] * 3
    B = [[zero] * 3 for _ in cp.AXES]
    for i, j, g in _windows(grid, st, fields):
        for k in cp.AXES:
            wx, wy, wz = sx.weights[i], sy.weights[j], sz.weights[k]
            slope = dx[0] * sx.slopes[i] * wy * wz + dx[1] * wx * sy.slopes[j] * wz + dx[2] * wx * wy * sz.slopes[k]
            d = (sx.offsets[i], sy.offsets[j], sz.offsets[k])
            for c in cp.AXES:
                q[c] = q[c] + slope * g[k][c]
                for a in cp.AXES:
                    B[c][a] = B[c][a] + slope * g[k][c] * d[a]
    return tuple(q), tuple(tuple(r) for r in B)  # type: ignore[return-value]
