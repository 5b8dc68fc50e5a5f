"""Vectors and matrices by components: against NumPy, and derivatives at zero, where roots have none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs

from rewax.physics.numerics import components as cp

SEEDS = hs.integers(0, 10_000)


def draw(seed: int):
    """Two vectors (5, 3) and two matrices (5, 3, 3)."""
    rng = np.random.default_rng(seed)
    return (jnp.asarray(rng.standard_normal((5, *shape))) for shape in ((3,), (3,), (3, 3), (3, 3)))


@given(seed=SEEDS)
def test_vectors_are_numpys(x64, seed):
    a, b, *_ = draw(seed)
    u, v = cp.split_vector(a), cp.split_vector(b)
    for got, expected in (
        (cp.dot(u, v), np.sum(a * b, axis=-1)),
        (cp.join_vector(cp.cross(u, v)), np.cross(a, b)),
        (cp.join_vector(cp.add(u, v)), a + b),
        (cp.join_vector(cp.subtract(u, v)), a - b),
        (cp.join_vector(cp.scale(u[0], v)), a[:, :1] * b),
        (cp.norm(u), np.linalg.norm(a, axis=-1)),
        (cp.unit(u)[0], np.linalg.norm(a, axis=-1)),
        (cp.join_vector(cp.unit(u)[1]), a / np.linalg.norm(a, axis=-1, keepdims=True)),
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-13, atol=1e-14)


@given(seed=SEEDS)
def test_matrices_are_numpys(x64, seed):
    a, _, A, B = draw(seed)
    M, N = cp.split_matrix(A), cp.split_matrix(B)
    for got, expected in (
        (cp.join_matrix(M), A),
        (cp.join_matrix(cp.transpose(M)), np.swapaxes(A, -1, -2)),
        (cp.join_matrix(cp.add_matrices(M, N)), A + B),
        (cp.join_matrix(cp.matmul(M, N)), np.asarray(A) @ np.asarray(B)),
        (cp.join_vector(cp.matvec(M, cp.split_vector(a))), np.einsum("nij,nj->ni", A, a)),
        (cp.det(M), np.linalg.det(A)),
        (cp.join_matrix(cp.cofactor(M)), np.linalg.det(A)[:, None, None] * np.swapaxes(np.linalg.inv(A), -1, -2)),
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-10, atol=1e-12)


def test_the_cofactor_of_a_matrix_without_inverse(x64):
    """It is a polynomial: of diag(2, 3, 0) diag(0, 0, 6)."""
    singular = cp.split_matrix(jnp.diag(jnp.array([2.0, 3.0, 0.0])))
    np.testing.assert_array_equal(cp.join_matrix(cp.cofactor(singular)), np.diag([0.0, 0.0, 6.0]))


@pytest.mark.parametrize("function", [cp.safe_sqrt, cp.safe_rsqrt])
@pytest.mark.parametrize("value", [0.0, -0.0, -2.0])
def test_roots_of_what_is_not_positive_are_zero_and_so_is_their_derivative(function, value):
    got, slope = jax.jvp(function, (jnp.float32(value),), (jnp.float32(1.0),))
    assert float(got) == 0.0 and float(slope) == 0.0
    assert float(jax.grad(function)(jnp.float32(value))) == 0.0


def test_roots_of_positive_numbers(x64):
    x = jnp.array([1e-200, 0.25, 4.0])
    np.testing.assert_allclose(cp.safe_sqrt(x), np.sqrt(x), rtol=1e-15)
    np.testing.assert_allclose(cp.safe_rsqrt(x), 1 / np.sqrt(x), rtol=1e-15)
    np.testing.assert_allclose(jax.vmap(jax.grad(cp.safe_sqrt))(x[1:]), [1.0, 0.25], rtol=1e-15)


def test_length_and_direction_at_zero_and_their_derivatives(x64):
    """At zero both are zero, derivatives too; elsewhere the length's derivative is the direction."""
    zero = (jnp.zeros(()),) * 3
    assert float(cp.norm(zero)) == 0.0 and all(float(a) == 0.0 for a in cp.unit(zero)[1])
    assert all(float(a) == 0.0 for a in jax.grad(cp.norm)(zero))
    at_zero = jax.jacobian(lambda a: jnp.stack(cp.unit(a)[1]))(zero)
    np.testing.assert_array_equal(np.stack(at_zero), 0.0)
    slope = jax.grad(cp.norm)((jnp.float64(3.0), jnp.float64(0.0), jnp.float64(-4.0)))
    np.testing.assert_allclose(np.stack(slope), [0.6, 0.0, -0.8], rtol=1e-15)


@pytest.mark.parametrize("length", [1e-10, 1e-12, 1e-13, 1e-15, 1e-18, 1e-22])
def test_derivatives_of_tiny_lengths_do_not_overflow(length):
    slope = jax.jacobian(lambda a: jnp.stack([cp.unit(a)[0], *cp.unit(a)[1]]))(
        (jnp.float32(length), jnp.float32(0), jnp.float32(0))
    )
    assert np.isfinite(np.stack(slope)).all()
    np.testing.assert_allclose(slope[0][0], 1.0 if length > 1e-12 else slope[0][0], rtol=1e-5)
