"""Products of small matrices: against NumPy, in full precision and in the precision of their arguments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs

from rewax.physics.rigid import small_products
from rewax.physics.rigid.small_products import compose, cross, dot, rotate, scatter, select


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


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray])
def test_matrix_products_ask_for_full_precision(kind):
    """Accelerators would round the factors of a float32 product."""
    matrix = kind(np.eye(3, dtype=np.float32))
    text = jax.jit(lambda a: dot(matrix, a)).lower(jnp.ones((3, 3))).as_text()
    assert "HIGHEST" in text


@pytest.mark.parametrize("shape", [(5,), (5, 3), (2, 5), (2, 4, 5, 3)])
def test_constant_matrices_do_the_same_on_every_platform(x64, shape):
    """Products with them and with their transposes, batched or not; the matrix with the batch's axes too."""
    rng = np.random.default_rng(0)
    vector = len(shape) in (1, 2) and shape[-1] == 5
    static, batch = small_products._Table(vector), shape[: -1 if vector else -2]
    there, back = small_products._TIMES, small_products._TRANSPOSED
    b = jnp.asarray(rng.standard_normal(shape))
    for a in (rng.standard_normal((4, 5)), rng.standard_normal((*batch, 4, 5))):
        expected = (a @ b[..., None])[..., 0] if vector else a @ b
        for one in (there.cpu, there.other):
            np.testing.assert_allclose(one(static, (jnp.asarray(a),), (b,))[0], expected, atol=1e-12)
        again = (np.swapaxes(a, -1, -2) @ expected[..., None])[..., 0] if vector else np.swapaxes(a, -1, -2) @ expected
        for one in (back.cpu, back.other):
            np.testing.assert_allclose(one(static, (jnp.asarray(a),), (jnp.asarray(expected),))[0], again, atol=1e-12)


def test_products_with_constant_matrices_have_both_derivatives_twice(x64):
    rng = np.random.default_rng(0)
    a, x, move = rng.standard_normal((4, 5)), *(jnp.asarray(rng.standard_normal((3, 5))) for _ in range(2))

    def outcome(x):
        return jnp.sum(jnp.sin(jax.vmap(lambda row: dot(a, row))(x)))

    def written_out(x):
        return jnp.sum(jnp.sin(x @ a.T))

    for order in (jax.grad, lambda f: jax.grad(lambda x: jnp.vdot(jax.grad(f)(x), move))):
        np.testing.assert_allclose(order(outcome)(x), order(written_out)(x), atol=1e-12)
    slopes = [jax.jvp(f, (x,), (move,))[1] for f in (outcome, written_out)]
    assert float(slopes[0]) == pytest.approx(float(slopes[1]), rel=1e-12)


def test_values_are_spread_to_their_places_and_picked_from_them(x64):
    index, values = np.array([4, 0, 3]), jnp.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    expected = np.array([[2.0, 0.0, 0.0, 3.0, 1.0], [5.0, 0.0, 0.0, 6.0, 4.0]])
    np.testing.assert_array_equal(jax.vmap(lambda v: scatter(index, v, 5))(values), expected)
    target = small_products._Target((4, 0, 3), 5)
    for one in (small_products._SCATTER.cpu, small_products._SCATTER.other):
        np.testing.assert_array_equal(one(target, (), (values,))[0], expected)
    weights = jnp.arange(10.0).reshape(2, 5)
    found = jax.grad(lambda v: jnp.vdot(weights, jax.vmap(lambda v: scatter(index, v, 5))(v)))(values)
    np.testing.assert_array_equal(found, weights[:, index])
