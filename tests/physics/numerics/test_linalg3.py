"""Spectral functions, polar decomposition, eigh and SVD: values, derivatives, and the cases where others divide by 0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs

from rewax.physics.numerics import components as cp
from rewax.physics.numerics import divided_differences as dd
from rewax.physics.numerics import linalg3

SINGULAR = [
    [1.0, 1.0, 1.0],
    [2.0, 2.0, 0.5],
    [2.0, 0.5, 0.5],
    [1.0, 1.0, -1.0],
    [1.3, 0.7, 1e-6],
    [1.3, 0.7, 0.0],
    [1.0, 0.0, 0.0],
    [0.0, 0.0, 0.0],
    [1.5, 1.0, -0.3],
    [1.0, 1.0 + 1e-7, 1.0 - 1e-7],
    [1e3, 1.0, 1e-3],
]
DISTINCT = [[1.5, 1.0, 0.6], [2.0, 1.2, -0.4], [1.1, 0.9, 0.3], [3.0, 1.0, 0.1]]
DTYPES = [np.float32, np.float64]

# Nothing here is jitted: op by op, small arrays of few shapes compile much faster than whole programs do.
svd, eigh = linalg3.svd, linalg3.eigh


def polar(a):
    return cp.join_matrix(linalg3.polar_components(cp.split_matrix(a)))


def decompose(a):
    return svd(a), eigh(a + jnp.swapaxes(a, -1, -2)), polar(a)


def tolerance(dtype) -> float:
    return 1e-5 if dtype == np.float32 else 1e-14


def assert_rotations(u, dtype):
    u = np.asarray(u, np.float64)
    np.testing.assert_allclose(u @ np.swapaxes(u, -1, -2), np.broadcast_to(np.eye(3), u.shape), atol=tolerance(dtype))
    np.testing.assert_allclose(np.linalg.det(u), 1.0, atol=tolerance(dtype))


@pytest.mark.parametrize("dtype", DTYPES)
def test_svd_reconstructs_with_rotations(x64, stretched, dtype):
    a = np.concatenate([np.diagflat(s)[None] for s in SINGULAR] + [stretched(0, SINGULAR + DISTINCT)]).astype(dtype)
    u, s, vt = svd(a)
    assert s.dtype == dtype
    scale = np.abs(a).max(axis=(1, 2))[:, None, None] + np.finfo(dtype).tiny
    np.testing.assert_allclose(np.asarray(u * s[:, None, :] @ vt) / scale, a / scale, atol=tolerance(dtype))
    assert_rotations(u, dtype)
    assert_rotations(vt, dtype)
    size = np.abs(np.asarray(s))
    assert np.all(np.diff(size, axis=-1) <= 1e-3 * np.finfo(dtype).eps ** 0.5 + size[:, :1] * 4e-4)
    regular = np.abs(np.linalg.det(a.astype(np.float64))) > 1e-3 * size.max(-1) ** 3
    assert regular.sum() >= 10
    np.testing.assert_array_equal(np.sign(s[regular]).prod(-1), np.sign(np.linalg.det(a[regular].astype(np.float64))))


@given(seed=hs.integers(0, 1000), log_scale=hs.floats(-3.0, 3.0))
def test_singular_values_agree_with_lapack(x64, seed, log_scale):
    a = np.random.default_rng(seed).standard_normal((15, 3, 3)) * 10.0**log_scale
    _, s, _ = svd(a)
    expected = np.linalg.svd(a, compute_uv=False)
    # Through A^T A, a small singular value is only known to sqrt(eps) of the largest unless recomputed from U and A V.
    np.testing.assert_allclose(np.abs(s) / expected[:, :1], expected / expected[:, :1], atol=1e-12)


@given(seed=hs.integers(0, 1000))
def test_eigh_agrees_with_lapack(x64, seed):
    a = np.random.default_rng(seed).standard_normal((15, 3, 3))
    a = a + np.swapaxes(a, -1, -2)
    values, u = eigh(a)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(a), atol=1e-13)
    u = np.asarray(u)
    np.testing.assert_allclose(u * np.asarray(values)[:, None, :] @ np.swapaxes(u, -1, -2), a, atol=1e-13)


@pytest.mark.parametrize("dtype", DTYPES)
def test_polar_is_the_nearest_rotation(x64, rotations, dtype):
    rotation, q = rotations(3, 6), rotations(5, 6)
    stretch = (
        q
        * np.array([[1.0, 1.0, 1.0], [2.0, 2.0, 0.5], [1.5, 1.0, 0.2], [1, 1, 1.0001], [4, 1, 1], [9, 2, 0.1]])[:, None]
    )
    stretch = stretch @ np.swapaxes(q, -1, -2)
    r = polar((stretch @ rotation).astype(dtype))
    np.testing.assert_allclose(r, rotation, atol=1e-4 if dtype == np.float32 else 1e-11)


@pytest.mark.parametrize(("dtype", "lowest"), [(np.float32, -45), (np.float64, -320)])
def test_eigenvalues_next_to_each_other_stay_whatever_the_off_diagonals(x64, dtype, lowest):
    """Off-diagonals whose squares underflow, next to equal diagonals: 1 must not become 1 +- 0.5."""
    tiny = 10.0 ** np.linspace(lowest, -1, 50 * (-1 - lowest))
    a = np.tile(np.eye(3), (len(tiny), 1, 1))
    a[:, 0, 1] = a[:, 1, 0] = tiny
    values, _ = eigh(jnp.asarray(a, dtype))
    expected = 1.0 + tiny[:, None] * np.array([-1.0, 0.0, 1.0])
    np.testing.assert_allclose(values, expected, atol=4 * np.finfo(dtype).eps)


def cube_and_trace(e, parameters):
    """b^3, p b tr b and the number p det b: their derivatives are known; two have cross terms and a parameter."""
    return dd.multiply(e, dd.multiply(e, e)), dd.scale(parameters * sum(e.values), e), parameters * e.product


def known(b, p):
    return b @ b @ b, p[:, None, None] * b * jnp.trace(b, axis1=-2, axis2=-1)[:, None, None], p * jnp.linalg.det(b)


def by_spectral(b, p):
    cube, trace, number = linalg3.spectral(cube_and_trace, cp.split_matrix(b), p)
    return cp.join_matrix(cube), cp.join_matrix(trace), number


@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-8, 1e-6, 1e-5, 1e-4, 1e-2, 1.0])
def test_spectral_derivative_is_exact_however_close_the_eigenvalues(x64, rotations, relative_error, gap):
    u = rotations(0, 4)
    e = np.array([[1.0, 1.0 + gap, 2.0], [2.0, 1.0, 1.0 + gap], [1.0 + gap, 1.0, 1.0 - gap], [1e-3, 1.0, 1.0 + gap]])
    b = jnp.asarray(np.einsum("nij,nj,nkj->nik", u, e, u))
    rng = np.random.default_rng(1)
    db = rng.standard_normal((4, 3, 3))
    db = jnp.asarray(db + np.swapaxes(db, -1, -2))
    p, dp = jnp.asarray(rng.standard_normal(4)), jnp.asarray(rng.standard_normal(4))
    value, tangent = jax.jvp(by_spectral, (b, p), (db, dp))
    expected, expected_tangent = jax.jvp(known, (b, p), (db, dp))
    assert relative_error(value, expected) < 1e-14
    # A difference of cubes over a gap of 1e-5 would be off by 2e-11, and a mean of slopes instead by gap^2 / 6.
    assert relative_error(tangent, expected_tangent) < 1e-13


def test_derivatives_equal_finite_differences(x64, stretched, random_like, central_difference, relative_error):
    a = jnp.asarray(stretched(0, DISTINCT * 4)[:15])
    da = random_like(1, a)
    _, tangent = jax.jvp(decompose, (a,), (da,))
    assert relative_error(tangent, central_difference(decompose, a, da, 1e-6)) < 1e-8
    cotangent = random_like(2, tangent)
    (gradient,) = jax.vjp(decompose, a)[1](cotangent)
    forward = sum(
        float(jnp.vdot(t, c)) for t, c in zip(jax.tree.leaves(tangent), jax.tree.leaves(cotangent), strict=True)
    )
    np.testing.assert_allclose(float(jnp.vdot(gradient, da)), forward, rtol=1e-11)


def test_polar_derivative_at_the_identity_is_the_skew_part(x64):
    da = jnp.asarray(np.random.default_rng(0).standard_normal((5, 3, 3)))
    a = jnp.broadcast_to(jnp.eye(3), (5, 3, 3))
    _, tangent = jax.jvp(polar, (a,), (da,))
    np.testing.assert_allclose(tangent, 0.5 * (da - jnp.swapaxes(da, -1, -2)), atol=1e-14)


@pytest.mark.parametrize("dtype", DTYPES)
def test_derivatives_are_finite_where_values_repeat_or_vanish(x64, stretched, dtype):
    a = np.concatenate([np.diagflat(s)[None] for s in SINGULAR] + [stretched(0, SINGULAR)]).astype(dtype)

    a = jnp.asarray(a)
    value, back = jax.vjp(decompose, a)
    (gradient,) = back(jax.tree.map(jnp.ones_like, value))
    finite = np.isfinite(gradient).all(axis=(1, 2))
    assert finite.all(), f"not finite for {a[~finite]}"


def test_second_derivatives_are_refused(x64, stretched):
    """They would lack the derivative of the eigenvectors."""
    a = jnp.asarray(stretched(0, DISTINCT)[0])
    first = jax.grad(lambda a: jnp.sum(jnp.sin(polar(a))))
    with pytest.raises(NotImplementedError):
        jax.jvp(first, (a,), (a,))
