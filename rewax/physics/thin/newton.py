"""Newton's method with conjugate gradients for fields of vectors, matrix-free, in loops of fixed largest length.

Fields are ``Vec3`` of arrays (num_vertices,). Under ``vmap`` every batch element stops on its own.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from rewax.lowering.kernels import pointwise
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.types import Array, Scalar

Linear: TypeAlias = Callable[[Vec3], Vec3]
HALVINGS = 12
"""Largest number of halvings of a Newton step."""
SUFFICIENT = 0.8
"""A step is taken where the slope along it is at most this share of minus the slope at its beginning: then the
trapezoidal rule finds that the potential fell."""
RIDGE = 1e-6
"""Share of its trace that is added to the diagonal of a block, and the least pivot, so that rounding leaves it positive
definite."""


class Blocks(NamedTuple):
    """Symmetric 3x3 blocks on the diagonal of a matrix, arrays (num_vertices,)."""

    diagonal: Vec3
    """xx, yy, zz."""
    mixed: Vec3
    """yz, zx, xy."""


class Factors(NamedTuple):
    """L D L^T of symmetric positive definite 3x3 blocks, arrays (num_vertices,)."""

    inverse: Vec3
    """1 / D."""
    lower: Vec3
    """L: yx, zx, zy."""


class Solved(NamedTuple):
    """Result of conjugate gradients."""

    x: Vec3
    solved: Array
    """Whether the residual is below the tolerance, shape ()."""
    negative: Array
    """Whether a direction without positive curvature ended the iteration, shape ()."""


class Minimum(NamedTuple):
    """Result of Newton's method."""

    x: Vec3
    error: Array
    """Root of twice the energy that the last Newton step promised over the mass [m/s], shape (); inf or above the
    tolerance: not converged."""
    iterations: Array


def inner(a: Vec3, b: Vec3) -> Array:
    """Sum of a . b over all vertices, shape ()."""
    return jnp.sum(cp.dot(a, b))


def conjugate_gradients(matrix: Linear, b: Vec3, precondition: Linear, *, tolerance: Scalar, iterations: int) -> Solved:
    """Solution of ``matrix(x) = b`` for a symmetric matrix.

    It ends where the preconditioned residual is below ``tolerance`` times its first norm, after ``iterations``, or at a
    direction p with p . matrix(p) <= 0. In the last case x is the solution so far, or the first direction: in both
    cases x . b > 0. The system is solved for b over its largest component: squares of large or small vectors would
    leave the range of float32, and 0 would count as their solution.

    Gradient: none.
    Source: Nocedal and Wright 2006, "Numerical optimization", algorithm 7.1.
    """

    class At(NamedTuple):
        x: Vec3
        r: Vec3
        p: Vec3
        rz: Array
        count: Array  # pyright: ignore[reportIncompatibleMethodOverride]
        negative: Array

    largest = jnp.max(jnp.abs(jnp.stack(b)))
    scale = jnp.where((largest > 0) & jnp.isfinite(largest), largest, 1.0)
    b = cp.vector(lambda i: b[i] / scale)
    z = precondition(b)
    first = inner(b, z)
    zero = cp.vector(lambda i: jnp.zeros_like(b[i]))

    def goes_on(at: At) -> Array:
        return (at.rz > tolerance**2 * first) & (at.count < iterations) & ~at.negative

    def step(at: At) -> At:
        q = matrix(at.p)
        curvature = inner(at.p, q)
        negative = ~(curvature > 0)
        size = jnp.where(negative, jnp.where(at.count == 0, 1.0, 0.0), at.rz / jnp.where(negative, 1.0, curvature))
        x, r = _add_scaled((size,), (at.x, at.p)), _add_scaled((-size,), (at.r, q))
        z = precondition(r)
        rz = inner(r, z)
        p = _add_scaled((rz / at.rz,), (z, at.p))
        return At(x, r, p, rz, at.count + 1, negative)

    start = At(zero, b, z, first, jnp.zeros((), jnp.int32), jnp.zeros_like(first, bool))
    end = jax.lax.while_loop(goes_on, step, start)
    # A preconditioner that rounding has made indefinite gives a negative square of a norm, and no solution.
    positive = (first >= 0) & jnp.isfinite(first) & (end.rz >= 0)
    x = cp.vector(lambda i: scale * end.x[i])
    return Solved(x, (end.rz <= tolerance**2 * first) & positive & ~end.negative, end.negative)


@pointwise
def _add_scaled(shared: tuple[Array], given: tuple[Vec3, Vec3]) -> Vec3:
    (size,), (a, b) = shared, given
    return cp.vector(lambda i: a[i] + size * b[i])


def minimize(
    gradient: Callable[[Vec3], Vec3],
    curvature: Callable[[Vec3, Array], Linear],
    blocks: Callable[[Vec3], Blocks],
    start: Vec3,
    *,
    mass: Array,
    tolerance: float,
    iterations: int,
    cg_tolerance: float,
    cg_iterations: int,
) -> Minimum:
    """A minimum of a potential.

    Args:
      gradient: of the potential [N].
      curvature: ``curvature(x, exact)`` is the product with the potential's second derivative at x if exact is 1, and
        with a positive definite approximation if it is 0.
      blocks: blocks on the diagonal of the second, at x.
      start: first guess.
      mass: total mass [kg], shape ().
      others: see ``Implicit``.

    Where conjugate gradients meet a direction of negative curvature, the next Newton step takes the positive definite
    matrix. A step is halved until the slope along it says that the potential falls. The iteration has converged when a
    Newton step with the exact matrix promises at most the energy mass tolerance^2 / 2; it takes this step too.

    Gradient: none.
    """

    class At(NamedTuple):
        x: Vec3
        g: Vec3
        exact: Array
        error: Array
        count: Array  # pyright: ignore[reportIncompatibleMethodOverride]
        done: Array

    def step(at: At) -> At:
        factors = factor_blocks(blocks(at.x))
        found = conjugate_gradients(
            curvature(at.x, at.exact),
            cp.scale(-1.0, at.g),
            lambda r: solve_blocks(factors, r),
            tolerance=cg_tolerance,
            iterations=cg_iterations,
        )
        slope = inner(at.g, found.x)
        error = jnp.sqrt(jnp.maximum(-slope, 0.0) / mass)
        done = found.solved & (at.exact > 0) & (error <= tolerance)
        x, g = _halve(gradient, at.x, found.x, slope, done)
        exact = jnp.where(found.negative, 0.0, 1.0).astype(at.exact.dtype)
        return At(x, g, exact, error, at.count + 1, done)

    g = gradient(start)
    one = jnp.ones_like(mass)
    begin = At(start, g, one, jnp.inf * one, jnp.zeros((), jnp.int32), jnp.zeros_like(mass, bool))
    end = jax.lax.while_loop(lambda at: ~at.done & (at.count < iterations), step, begin)
    missed = jnp.where(end.error > tolerance, end.error, jnp.inf)
    return Minimum(end.x, jnp.where(end.done, end.error, missed), end.count)


def _halve(
    gradient: Callable[[Vec3], Vec3], x: Vec3, direction: Vec3, slope: Array, accepted: Array
) -> tuple[Vec3, Vec3]:
    """The end of a step along a direction, and the gradient there."""

    def at(size: Array) -> tuple[Vec3, Vec3]:
        there = _add_scaled((size,), (x, direction))
        return there, gradient(there)

    def fails(carry: tuple) -> Array:
        _, _, g, count = carry
        return ~accepted & ~(inner(g, direction) <= -SUFFICIENT * slope) & (count < HALVINGS)

    def halve(carry: tuple) -> tuple:
        size, _, _, count = carry
        return (0.5 * size, *at(0.5 * size), count + 1)

    one = jnp.ones_like(slope)
    _, there, g, _ = jax.lax.while_loop(fails, halve, (one, *at(one), jnp.zeros((), jnp.int32)))
    return there, g


# --- Blocks -----------------------------------------------------------------------------------------------------------


def factor_blocks(blocks: Blocks) -> Factors:
    """Factors of positive definite blocks. Gradient: exact.

    Cofactors and the determinant would lose all digits where one direction is a million times as stiff as another, as
    along a straight rope: in float32 the inverse was then not even positive.
    """
    return _factors((), blocks)


@pointwise
def _factors(shared: tuple, blocks: Blocks) -> Factors:
    del shared
    ridge = RIDGE * (blocks.diagonal[0] + blocks.diagonal[1] + blocks.diagonal[2])
    xx, yy, zz = (d + ridge for d in blocks.diagonal)
    yz, zx, xy = blocks.mixed
    lower_yx, lower_zx = xy / xx, zx / xx
    second = jnp.maximum(yy - lower_yx * xy, ridge)
    rest = yz - lower_zx * xy
    lower_zy = rest / second
    third = jnp.maximum(zz - lower_zx * zx - lower_zy * rest, ridge)
    return Factors((1.0 / xx, 1.0 / second, 1.0 / third), (lower_yx, lower_zx, lower_zy))


def solve_blocks(factors: Factors, vectors: Vec3) -> Vec3:
    """Solutions of the systems of all blocks. Gradient: exact."""
    return _solve((), (factors, vectors))


@pointwise
def _solve(shared: tuple, given: tuple[Factors, Vec3]) -> Vec3:
    del shared
    (inverse, (yx, zx, zy)), (x, y, z) = given
    y = y - yx * x
    z = inverse[2] * (z - zx * x - zy * y)
    y = inverse[1] * y - zy * z
    return inverse[0] * x - yx * y - zx * z, y, z


__all__ = ["Blocks", "Minimum", "Solved", "conjugate_gradients", "factor_blocks", "inner", "minimize", "solve_blocks"]
