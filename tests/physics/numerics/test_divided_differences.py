"""Divided differences of every operation: those of longer numbers, however close the arguments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.numerics import divided_differences as dd

GAPS = [0.0, 1e-16, 3e-15, 1e-12, 1e-9, 1e-7, 3e-6, 1e-4, 1e-2, 0.1, 0.3, 1.0, 20.0]
POINTS, WEIGHTS = np.polynomial.legendre.leggauss(20)
OPERATIONS = {
    "log": (dd.log, np.log, lambda x: 1 / x),
    "exp": (dd.exp, np.exp, np.exp),
    "expm1": (dd.expm1, np.expm1, np.exp),
    "sqrt": (dd.sqrt, np.sqrt, lambda x: 0.5 / np.sqrt(x)),
    "reciprocal": (dd.reciprocal, lambda x: 1 / x, lambda x: -1 / x**2),
    "square": (lambda p: dd.multiply(p, p), np.square, lambda x: 2 * x),
    "sum": (lambda p: dd.add(dd.scale(3.0, p), dd.shift(dd.log(p), 2.0)), lambda x: 3 * x + np.log(x) + 2, lambda x: 3 + 1 / x),
    "operators": (lambda p: 2.0 - 3.0 / (p * p + 1.0) - (-p) / (p - 30.0) + 0.5 * p / 4.0,
                  lambda x: 2 - 3 / (x * x + 1) + x / (x - 30) + 0.125 * x,
                  lambda x: 6 * x / (x * x + 1) ** 2 - 30 / (x - 30) ** 2 + 0.125),
    "chain": (
        lambda p: dd.multiply(dd.sqrt(p), dd.exp(dd.scale(-1.0, dd.log(p)))),
        lambda x: 1 / np.sqrt(x),
        lambda x: -0.5 * x**-1.5,
    ),
}  # fmt: skip


def arguments(dtype, center: float):
    """Pairs of close numbers, and a third one far away."""
    first = np.full(len(GAPS), center, dtype)
    second = (center + np.asarray(GAPS)).astype(dtype)
    return dd.eigenvalues((jnp.asarray(first), jnp.asarray(second), jnp.asarray(first + 3).astype(dtype)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", OPERATIONS)
def test_differences_are_accurate_however_close_the_arguments(x64, name, dtype):
    operation, f, slope = OPERATIONS[name]
    for center in (1.0, 0.02, 5.0):
        p = arguments(dtype, center)
        found = operation(p)
        assert found.values[0].dtype == found.differences[0].dtype == dtype
        a, b = (np.asarray(v).astype(np.longdouble) for v in p.values[:2])
        # A difference is the mean slope in between: by Gauss's rule where that is exact to longer numbers.
        mean = sum(w * slope(a + t * (b - a)) for t, w in zip(0.5 + 0.5 * POINTS, 0.5 * WEIGHTS, strict=True))
        far = b - a > 0.3 * center
        expected = np.where(far, (f(b) - f(a)) / np.where(far, b - a, 1), mean)
        np.testing.assert_allclose(
            np.asarray(found.differences[2], np.longdouble), expected, rtol=20 * np.finfo(dtype).eps
        )
        np.testing.assert_allclose(np.asarray(found.values[1], np.longdouble), f(b), rtol=20 * np.finfo(dtype).eps)


def test_each_pair_has_its_own_difference(x64):
    found = dd.log(dd.eigenvalues(tuple(jnp.asarray(a) for a in (1.0, 2.0, 5.0))))
    expected = [np.log(2.5) / 3.0, np.log(5.0) / 4.0, np.log(2.0)]
    np.testing.assert_allclose(np.stack(found.differences), expected, rtol=1e-15)


def test_clipped_numbers_have_the_slope_of_the_chord(x64):
    p = dd.eigenvalues(
        tuple(jnp.asarray(a) for a in ([1.0, 1.0, 1.0, 3.0], [2.0, 3.0, 1.0, 3.0], [1.5, 5.0, 1.0, 3.0]))
    )
    low, high = dd.maximum(p, 1.25), dd.minimum(p, 2.5)
    np.testing.assert_allclose(low.differences[2], [0.75, 1.75 / 2.0, 0.0, 1.0])
    np.testing.assert_allclose(high.differences[2], [1.0, 0.75, 1.0, 0.0])


def test_chosen_and_uniform_numbers(x64):
    p = dd.eigenvalues(tuple(jnp.asarray([a, a]) for a in (1.0, 2.0, 4.0)))
    mixed = dd.select(jnp.asarray([True, False]), dd.multiply(p, p), dd.uniform(jnp.asarray([7.0, 7.0]), p))
    np.testing.assert_allclose(np.stack(mixed.values), [[1.0, 7.0], [4.0, 7.0], [16.0, 7.0]])
    np.testing.assert_allclose(np.stack(mixed.differences), [[6.0, 0.0], [5.0, 0.0], [3.0, 0.0]])
    assert dd.log(dd.Principal(p.values)).differences is None


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_exponential_minus_one_and_its_derivative(x64, dtype):
    x = np.concatenate([[0.0], *(s * 10.0 ** np.arange(-12.0, 1.0) for s in (1, -1)), [0.1999, 0.2001, 5.0]]).astype(
        dtype
    )
    value, slope = jax.jvp(dd.exp_minus_one, (jnp.asarray(x),), (jnp.ones_like(x),))
    eps = np.finfo(dtype).eps
    np.testing.assert_allclose(np.asarray(value, np.float64), np.expm1(x.astype(np.float64)), rtol=8 * eps, atol=0)
    np.testing.assert_allclose(slope, np.exp(x.astype(np.float64)), rtol=4 * eps)
    assert value[0] == 0.0


def test_sum_and_product_are_numbers_of_all_axes():
    p = dd.eigenvalues((jnp.float32(2.0), jnp.float32(3.0), jnp.float32(5.0)))
    assert float(p.sum) == 10.0 and float(p.product) == 30.0


def test_numpy_leaves_operators_to_principal_values():
    p = dd.eigenvalues((jnp.float32(2.0), jnp.float32(3.0), jnp.float32(5.0)))
    assert isinstance(np.float32(2.0) * p, dd.Principal) and isinstance(np.ones(()) + p, dd.Principal)


@pytest.mark.parametrize("limit", [dd.maximum, dd.minimum])
def test_at_a_limit_the_derivative_is_that_of_the_argument(x64, limit):
    """Of values and of divided differences alike, so that it is the same in all directions."""
    at = lambda x: limit(dd.Principal((x, jnp.float64(3.0), jnp.float64(3.0)), (jnp.float64(1.0),) * 3), 3.0)  # noqa: E731
    assert float(jax.grad(lambda x: at(x).values[0])(3.0)) == 1.0
    np.testing.assert_array_equal(at(jnp.float64(3.0)).differences, 1.0)
