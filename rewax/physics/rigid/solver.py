"""Constraint forces of articulated bodies: a convex problem in the joint accelerations, and its derivative.

Each constraint row exerts the force of a bounded spring on its acceleration J a: f = clip(-D (J a - a_ref), lower,
upper). Equalities have no bounds. Dry friction is bounded by plus and minus its limit. Forces of contacts and limits
are never negative. The accelerations satisfy

    M a = force + J^T f(a),

which is the minimum of a strictly convex, piecewise quadratic function. Newton's method with an exact line search finds
it in a few steps. It has converged when a full step clips the same rows as the step before.

Source: Todorov 2014, Convex and analytically-invertible dynamics with contacts and constraints, section IV (primal
form, pyramidal cones), as in MuJoCo's Newton solver. Deviation: the line search over the kinks is rewax's own.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.linear_primitive import Arrays, ByPlatform, linear_call, no_transpose
from rewax.lowering.structural import structural_zeros
from rewax.physics.rigid.line_search import Rows, clipped_forces, exact_line_search, side_of
from rewax.types import Array


def row_forces(rows: Rows, qacc: Array) -> Array:
    """Force of each constraint at given accelerations [N or N m], shape (num_rows,).

    Limits and contacts only push (>= 0). Each edge of a friction pyramid is a row. Dry friction is bounded.

    Gradient: exact, zero where clipped. Source: Todorov 2014, "Convex and analytically-invertible dynamics with
      contacts and constraints in MuJoCo".
    """
    return clipped_forces(rows, _dot(rows.jacobian, qacc) - rows.target)


def curvature(mass: Array, rows: Rows, qacc: Array) -> Array:
    """M + J^T D J over the unclipped rows, shape (num_dofs, num_dofs): symmetric, positive definite."""
    return _curvature(mass, rows, side_of(rows, _dot(rows.jacobian, qacc) - rows.target))


def solve_accelerations(
    mass: Array, force: Array, rows: Rows, start: Array, *, max_iterations: int, num_bounded: int
) -> tuple[Array, Array]:
    """Joint accelerations a with M a = force + J^T f(a), and whether they are not found.

    Args:
      mass: M, symmetric, positive definite, shape (num_dofs, num_dofs).
      force: generalized forces without those of the constraints, shape (num_dofs,).
      rows: the constraints.
      start: first guess, shape (num_dofs,); only the number of iterations depends on it.
      max_iterations: largest number of Newton steps.
      num_bounded: number of leading rows that can have a finite upper bound.

    Returns:
      The accelerations, shape (num_dofs,): the last iterate if ``max_iterations`` do not suffice. 1.0 if they do not
      suffice, else 0.0, shape ().

    Gradient: none; see ``implicit_correction``.
    """
    if rows.jacobian.shape[0] == 0:
        return solve_spd(mass, force), jnp.zeros_like(start, shape=())

    class Iterate(NamedTuple):
        qacc: Array
        missed: Array
        side: Array
        count: Array  # pyright: ignore[reportIncompatibleMethodOverride]
        done: Array

    def step(at: Iterate) -> Iterate:
        gradient = _dot(mass, at.qacc) - force - _dot(rows.jacobian.T, clipped_forces(rows, at.missed))
        direction = -solve_spd(_curvature(mass, rows, at.side), gradient)
        change = _dot(rows.jacobian, direction)
        slope, curve = jnp.sum(direction * gradient), jnp.sum(direction * _dot(mass, direction))
        length = exact_line_search(rows, at.missed, change, slope, curve, num_bounded)
        qacc = at.qacc + length * direction
        missed = _dot(rows.jacobian, qacc) - rows.target
        side = side_of(rows, missed)
        small = jnp.max(jnp.abs(direction)) <= 4 * jnp.finfo(qacc.dtype).eps * (1.0 + jnp.max(jnp.abs(qacc)))
        return Iterate(qacc, missed, side, at.count + 1, small | jnp.all(side == at.side))

    missed = _dot(rows.jacobian, start) - rows.target
    begin = Iterate(start, missed, side_of(rows, missed), jnp.zeros((), jnp.int32), jnp.zeros_like(start, bool, ()))
    end = jax.lax.while_loop(lambda at: ~at.done & (at.count < max_iterations), step, begin)
    return end.qacc, 1.0 - end.done.astype(end.qacc.dtype)


def implicit_correction(matrix: Array, residual: Array, *, symmetric: bool = True) -> Array:
    """Returns zero. Its derivative is that of ``solve(matrix, residual)``.

    The residual must be zero, that of a converged solver. ``a - implicit_correction(curvature, M a - force - J^T
    f(a))``, with a and the matrix held fixed, has the value of a. By the implicit function theorem its derivative is
    that of the solution.

    Args:
      matrix: positive definite, shape (n, n); it gets no derivative.
      residual: shape (n,).
      symmetric: whether the matrix is.

    Gradient: with respect to the residual, forward (JVP) and reverse (VJP).
    """
    return _implicit_correction(symmetric, jax.lax.stop_gradient(matrix), residual)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _implicit_correction(symmetric: bool, matrix: Array, residual: Array) -> Array:
    del symmetric, matrix
    return jnp.zeros_like(residual)


@_implicit_correction.defjvp
def _implicit_correction_jvp(
    symmetric: bool, primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Array, Array]:
    matrix, residual = primals
    solution = jax.lax.custom_linear_solve(
        lambda x: _dot(matrix, x),
        tangents[1],
        lambda _, b: solve_spd(matrix, b),
        None if symmetric else lambda _, b: solve_spd(matrix.T, b),
        symmetric=symmetric,
    )
    return jnp.zeros_like(residual), solution


@jax.custom_batching.custom_vmap
def solve_spd(matrix: Array, vector: Array) -> Array:
    """Solves ``matrix x = vector`` for a positive definite matrix; x has shape (n,).

    Gauss-Jordan elimination without pivots, in one small loop. Batches of LAPACK's Cholesky can deadlock on a CPU
    (jaxlib 0.10). Gradient: none.
    """
    return _eliminate(matrix[..., None], vector[..., None])[..., 0]


@solve_spd.def_vmap
def _solve_batch(axis_size: int, batched: list[bool], matrix: Array, vector: Array) -> tuple[Array, bool]:
    """Makes the batch the innermost axis, along which processors vectorise."""
    matrix, vector = (
        jnp.moveaxis(a, 0, -1) if b else jnp.broadcast_to(a[..., None], (*a.shape, axis_size))
        for a, b in zip((matrix, vector), batched, strict=True)
    )
    return jnp.moveaxis(_eliminate(matrix, vector), -1, 0), True


def _eliminate(matrix: Array, vector: Array) -> Array:
    """Solutions of a batch of systems, shapes (n, n, batch) and (n, batch)."""
    return linear_call(_ELIMINATION, no_transpose, None, (matrix, vector), (), like=(vector,))[0]


def _elimination(static: None, residuals: Arrays, linear: Arrays, *, unroll: bool) -> Arrays:
    del static, linear
    matrix, vector = residuals
    num = vector.shape[-2]
    index = np.arange(num)[:, None, None]

    def eliminate(k: Array, table: Array) -> Array:
        column = jax.lax.dynamic_slice_in_dim(table, k, 1, axis=-2)
        pivot_row = jax.lax.dynamic_slice_in_dim(table, k, 1, axis=-3)
        pivot = jax.lax.dynamic_slice_in_dim(pivot_row, k, 1, axis=-2)
        return table - (column - (index == k)) * (pivot_row / pivot)

    table = jnp.concatenate([matrix, vector[..., None, :]], axis=-2)
    return (jax.lax.fori_loop(0, num, eliminate, table, unroll=True if unroll else None)[..., -1, :],)


def _elimination_in_scalars(static: None, residuals: Arrays, linear: Arrays) -> Arrays:
    """Elimination from the last unknown to the first: a tree's mass matrix keeps its structural zeros.

    Source: Featherstone 2008, Rigid Body Dynamics Algorithms, section 6.5.
    """
    del static, linear
    matrix, vector = structural_zeros(residuals[0]), residuals[1]
    rows = []
    for k in reversed(range(vector.shape[0])):
        row, right = matrix[k] / matrix[k, k], vector[k] / matrix[k, k]
        rows.append((row[:k], right))
        factor = matrix[:k, k]
        matrix, vector = matrix[:k, :k] - factor[:, None] * row[:k], vector[:k] - factor * right
    solution = vector
    for row, right in reversed(rows):
        solution = jnp.concatenate([solution, (right - jnp.sum(row * solution, axis=0))[None]])
    return (solution,)


# On a GPU each iteration of a loop would launch kernels and copies of its own.
_ELIMINATION = ByPlatform(
    cpu=functools.partial(_elimination, unroll=False),
    other=functools.partial(_elimination, unroll=True),
    scalar=_elimination_in_scalars,
)


def _curvature(mass: Array, rows: Rows, side: Array) -> Array:
    return mass + _dot(rows.jacobian.T, jnp.where(side == 0, rows.stiffness, 0.0)[:, None] * rows.jacobian)


def _dot(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)
