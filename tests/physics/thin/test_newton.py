"""Newton's method with conjugate gradients on matrices and potentials with known minima."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.numerics import components as cp
from rewax.physics.thin import newton

COUNT = 5


def field(flat):
    return cp.split_vector(jnp.asarray(flat).reshape(COUNT, 3))


def flat(x):
    return np.asarray(jnp.stack(x, axis=-1)).reshape(-1)


def spread(seed=0, smallest=1.0):
    rng = np.random.default_rng(seed)
    q = np.linalg.qr(rng.standard_normal((3 * COUNT, 3 * COUNT)))[0]
    return (q * np.linspace(smallest, 30.0, 3 * COUNT)) @ q.T


def linear(matrix):
    return lambda x: field(jnp.asarray(matrix) @ jnp.stack(x, axis=-1).reshape(-1))


def diagonal_blocks(matrix):
    own = jnp.asarray(matrix.reshape(COUNT, 3, COUNT, 3)[np.arange(COUNT), :, np.arange(COUNT)])
    mixed = cp.vector(lambda i: own[:, (i + 1) % 3, (i + 2) % 3])
    return newton.Blocks(cp.vector(lambda i: own[:, i, i]), mixed)


def test_conjugate_gradients_solve(x64):
    matrix, b = spread(), np.sin(np.arange(3.0 * COUNT))
    factors = newton.factor_blocks(diagonal_blocks(matrix))
    found = newton.conjugate_gradients(
        linear(matrix), field(b), lambda r: newton.solve_blocks(factors, r), tolerance=1e-12, iterations=40
    )
    assert found.solved and not found.negative
    np.testing.assert_allclose(flat(found.x), np.linalg.solve(matrix, b), rtol=1e-9)
    early = newton.conjugate_gradients(linear(matrix), field(b), lambda r: r, tolerance=1e-12, iterations=3)
    assert not early.solved


def test_a_direction_of_negative_curvature_ends_the_solution_downhill(x64):
    matrix, b = spread(smallest=-3.0), np.sin(np.arange(3.0 * COUNT))
    found = newton.conjugate_gradients(linear(matrix), field(b), lambda r: r, tolerance=1e-9, iterations=40)
    assert found.negative and not found.solved
    assert flat(found.x) @ b > 0
    none = newton.conjugate_gradients(linear(matrix), field(0 * b), lambda r: r, tolerance=1e-9, iterations=40)
    assert none.solved and not none.negative


def test_an_indefinite_preconditioner_solves_nothing(x64):
    """The square of its first norm is negative, and so below any tolerance."""
    matrix, b = spread(), np.sin(np.arange(3.0 * COUNT))
    found = newton.conjugate_gradients(
        linear(matrix), field(b), lambda r: cp.scale(-1.0, r), tolerance=1e-9, iterations=40
    )
    assert not found.solved


@pytest.mark.parametrize("size", [1e-30, 1e25])
def test_large_and_small_right_sides_are_solved_in_single_precision(size):
    """Their squares are 0 or inf in float32, so that 0 would pass for the solution."""
    matrix, b = spread(), np.sin(np.arange(3.0 * COUNT))
    right = field(jnp.asarray(size * b, jnp.float32))
    found = newton.conjugate_gradients(linear(matrix), right, lambda r: r, tolerance=1e-5, iterations=200)
    assert found.solved
    np.testing.assert_allclose(flat(found.x) / size, np.linalg.solve(matrix, b), rtol=1e-3, atol=1e-5)
    endless = newton.conjugate_gradients(
        linear(matrix), field(jnp.full(3 * COUNT, jnp.inf)), lambda r: r, tolerance=1e-5, iterations=200
    )
    assert not endless.solved and np.all(flat(endless.x) == 0.0)


def stored(a):
    return newton.Blocks(
        cp.vector(lambda i: jnp.asarray(a[:, i, i])),
        cp.vector(lambda i: jnp.asarray(a[:, (i + 1) % 3, (i + 2) % 3])),
    )


def test_factors_solve_the_blocks(x64):
    rng = np.random.default_rng(1)
    a = rng.standard_normal((COUNT, 3, 3))
    a = a @ a.swapaxes(1, 2) + np.eye(3)
    v = rng.standard_normal((COUNT, 3))
    found = newton.solve_blocks(newton.factor_blocks(stored(a)), field(np.einsum("nij,nj->ni", a, v)))
    np.testing.assert_allclose(flat(found).reshape(COUNT, 3), v, rtol=1e-3)  # but for the ridge


def test_factors_of_one_stiff_direction_stay_positive_in_float32():
    """As along a straight rope: one direction is up to a hundred million times as stiff as the others."""
    rng = np.random.default_rng(3)
    n = rng.standard_normal((COUNT, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    for ratio in (1e3, 1e5, 1e6, 1e8):
        a = (np.eye(3) + ratio * np.einsum("ni,nj->nij", n, n)).astype(np.float32)
        factors = newton.factor_blocks(stored(a))
        columns = [
            newton.solve_blocks(factors, field(np.tile(np.eye(3, dtype=np.float32)[i], COUNT))) for i in range(3)
        ]
        inverse = np.stack([flat(column).reshape(COUNT, 3) for column in columns], axis=-1).astype(np.float64)
        lowest = np.linalg.eigvalsh(0.5 * (inverse + inverse.swapaxes(1, 2)))
        assert lowest.min() > 0.0 and 0.2 < lowest.max() * (1.0 + newton.RIDGE * ratio) < 1.2, ratio
        along = newton.solve_blocks(factors, field(n.astype(np.float32)))
        assert float(jnp.min(cp.dot(along, field(n.astype(np.float32))))) > 0.0


def minimum(start, iterations=60):
    """Of sum (|x|^2 - 1)^2 + 0.3 x, which has a ring of negative curvature around zero."""

    def gradient(x):
        square = cp.dot(x, x) - 1.0
        return cp.vector(lambda i: 4.0 * square * x[i] + 0.3 * (i == 0))

    def curvature(x, exact):
        def product(p):
            square, along = cp.dot(x, x) - 1.0, cp.dot(x, p)
            kept = jnp.where(square < 0, exact * square, square)
            return cp.vector(lambda i: 8.0 * along * x[i] + 4.0 * kept * p[i] + 1e-3 * (1 - exact) * p[i])

        return product

    one, zero = jnp.ones(COUNT), jnp.zeros(COUNT)
    return newton.minimize(
        gradient,
        curvature,
        lambda x: newton.Blocks((one, one, one), (zero, zero, zero)),
        start,
        mass=jnp.ones(()),
        tolerance=1e-9,
        iterations=iterations,
        cg_tolerance=1e-6,
        cg_iterations=40,
    )


def test_it_finds_the_minimum_from_where_the_curvature_is_negative(x64):
    rng = np.random.default_rng(2)
    starts = jnp.asarray(rng.uniform(-1.0, 0.2, (4, 3, COUNT)))
    found = jax.jit(jax.vmap(lambda s: minimum((s[0], s[1], s[2]))))(starts)
    assert np.all(found.error <= 1e-9) and np.all(found.iterations < 60)
    lowest = np.roots([4.0, 0.0, -4.0, 0.3]).real.min()
    np.testing.assert_allclose(found.x[0], lowest, atol=1e-6)
    np.testing.assert_allclose(found.x[1], 0.0, atol=1e-5)
    for k in range(4):  # every batch element stops on its own
        alone = jax.jit(minimum)(cp.vector(lambda i, k=k: starts[k, i]))
        np.testing.assert_allclose(alone.x[0], found.x[0][k], rtol=1e-12)
        assert alone.iterations == found.iterations[k]


def test_it_says_that_it_has_not_converged(x64):
    assert not minimum(field(np.full(3 * COUNT, 0.4)), iterations=2).error <= 1e-9
    bad = minimum(field(np.full(3 * COUNT, np.nan)), iterations=5)
    assert not bad.error <= 1e-9
