"""Vectors and 3x3 matrices as tuples of components, one array per component.

XLA on a CPU fuses elementwise arithmetic on separate arrays into single loops. Reductions over an axis of length three
and slices of stacked matrices are slow: 10x and more in a substep. So the inner loops of rewax carry
``Vec3 = (x, y, z)`` and ``Mat3 = ((a00, a01, a02), ...)``. ``split_*`` and ``join_*`` convert from and to the users'
``(..., 3)`` and ``(..., 3, 3)`` arrays.

All functions broadcast over the components' shape. Gradient: exact, except where a docstring says otherwise.
"""

from typing import TypeAlias

import jax
import jax.numpy as jnp

from rewax.types import Array, Scalar

Vec3: TypeAlias = tuple[Array, Array, Array]
Mat3: TypeAlias = tuple[Vec3, Vec3, Vec3]

AXES = (0, 1, 2)


def split_vector(a: Array) -> Vec3:
    """Components of an array of shape (..., 3), each of shape (...)."""
    return (a[..., 0], a[..., 1], a[..., 2])


def join_vector(a: Vec3) -> Array:
    """Inverse of ``split_vector``: shape (..., 3)."""
    return jnp.stack(a, axis=-1)


def split_matrix(a: Array) -> Mat3:
    """Components of an array of shape (..., 3, 3), each of shape (...)."""
    return (split_vector(a[..., 0, :]), split_vector(a[..., 1, :]), split_vector(a[..., 2, :]))


def join_matrix(a: Mat3) -> Array:
    """Inverse of ``split_matrix``: shape (..., 3, 3)."""
    return jnp.stack([join_vector(row) for row in a], axis=-2)


def matrix(f) -> Mat3:
    """The matrix whose component (i, j) is ``f(i, j)``."""
    return tuple(tuple(f(i, j) for j in AXES) for i in AXES)  # type: ignore[return-value]


def vector(f) -> Vec3:
    """The vector whose component i is ``f(i)``."""
    return tuple(f(i) for i in AXES)  # type: ignore[return-value]


def dot(a: Vec3, b: Vec3) -> Array:
    """The inner product a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vec3, b: Vec3) -> Vec3:
    """The cross product a x b."""
    return vector(lambda i: a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3])


def add(a: Vec3, b: Vec3) -> Vec3:
    """a + b."""
    return vector(lambda i: a[i] + b[i])


def subtract(a: Vec3, b: Vec3) -> Vec3:
    """a - b."""
    return vector(lambda i: a[i] - b[i])


def scale(s: Scalar, a: Vec3) -> Vec3:
    """s a, for a number or an array s."""
    return vector(lambda i: s * a[i])


def safe_sqrt(a: Array) -> Array:
    """Square root whose derivative at zero is zero instead of infinite; zero for negative numbers too."""
    positive = a > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, a, 1.0)), 0.0)


def safe_rsqrt(a: Array) -> Array:
    """1 / sqrt(a); zero, with derivative zero, where a is not positive, or where the derivative would overflow."""
    positive = a > jnp.finfo(jnp.result_type(a)).tiny ** (2.0 / 3.0)
    return jnp.where(positive, jax.lax.rsqrt(jnp.where(positive, a, 1.0)), 0.0)


def norm(a: Vec3) -> Array:
    """Euclidean length. Gradient: exact, zero at the zero vector."""
    return safe_sqrt(dot(a, a))


def unit(a: Vec3) -> tuple[Array, Vec3]:
    """Length and direction; the zero vector has direction zero. Gradient: exact, zero at the zero vector."""
    square = dot(a, a)
    inverse = safe_rsqrt(square)
    return square * inverse, scale(inverse, a)


def add_matrices(a: Mat3, b: Mat3) -> Mat3:
    """a + b."""
    return matrix(lambda i, j: a[i][j] + b[i][j])


def transpose(a: Mat3) -> Mat3:
    """The transpose of a."""
    return matrix(lambda i, j: a[j][i])


def matmul(a: Mat3, b: Mat3) -> Mat3:
    """The matrix product a b."""
    return matrix(lambda i, j: a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j])


def matvec(a: Mat3, b: Vec3) -> Vec3:
    """The product a b of a matrix and a vector."""
    return vector(lambda i: dot(a[i], b))


def cofactor(a: Mat3) -> Mat3:
    """Matrix of cofactors: det(a) times the inverse transpose."""

    def entry(i: int, j: int) -> Array:
        p, q, r, s = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
        return a[p][r] * a[q][s] - a[p][s] * a[q][r]

    return matrix(entry)


def det(a: Mat3) -> Array:
    """The determinant of a."""
    return dot(a[0], cross(a[1], a[2]))
