"""Products of small matrices: against NumPy, in full precision and in the precision of their arguments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs

from rewax.physics.rigid.small_products import compose, cross, dot, rotate, select


@given(seed=hs.integers(0, 10_000))
def test_products_are_numpys(x64, seed):
    rng = np.random.default_rng(seed)
    a, b, v, w = (rng.standard_normal((6, *shape)) for shape in ((3, 3), (3, 3), (3,), (3,)))
    pairs = (
        (compose(a, b), a @ b),
        (rotate(a, v), np.einsum("nij,nj->ni", a, v)),
        (cross(v, w), np.cross(v, w)),
        (dot(v.T, jnp.asarray(w)), v.T @ w),
    )
    for got, expected in pairs:
        np.testing.assert_allclose(got, expected, atol=1e-13)


@given(seed=hs.integers(0, 10_000), shape=hs.sampled_from([(5,), (5, 3), (5, 3, 3)]))
def test_selected_rows_are_those_of_the_table(seed, shape):
    """To the bit, also several times and in any order, and none."""
    rng = np.random.default_rng(seed)
    table = jnp.asarray(rng.standard_normal(shape), jnp.float32)
    for index in (rng.integers(0, 5, 7), np.zeros(0, int)):
        np.testing.assert_array_equal(select(index, table), np.asarray(table)[index])


def test_the_derivative_of_a_selection_adds_up_what_is_selected_twice():
    table, index = jnp.zeros((4, 2)), np.array([1, 3, 1])
    weights = jnp.array([[1.0, 2.0], [3.0, 4.0], [10.0, 20.0]])
    gradient = jax.grad(lambda t: jnp.vdot(weights, select(index, t)))(table)
    np.testing.assert_array_equal(gradient, [[0.0, 0.0], [11.0, 22.0], [0.0, 0.0], [3.0, 4.0]])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_constant_in_double_precision_does_not_promote(x64, dtype):
    value = jnp.ones((3, 2), dtype)
    assert dot(np.eye(3), value).dtype == select(np.array([0]), value).dtype == dtype


def test_matrix_products_ask_for_full_precision():
    """Accelerators would round the factors of a float32 product."""
    text = str(jax.make_jaxpr(lambda a: dot(np.eye(3), a))(jnp.ones((3, 3))))
    assert "HIGHEST" in text
