"""The convex problem of constraint forces: its minimum by brute force, its derivative, the steps that lead there."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from constraint_problems import SIX, cost, problem, spd
from hypothesis import given
from hypothesis import strategies as st
from sharded import traced_under_shard_map

from rewax.physics.rigid import solver as cs
from rewax.physics.rigid.solver import Rows

SEEDS = st.integers(0, 10**6)


# --- Linear systems ---------------------------------------------------------------------------------------------------

solve = jax.jit(cs.solve_spd)


@given(seed=SEEDS, n=st.sampled_from([1, 2, 5, 14]), decades=st.integers(0, 8))
def test_solve_spd(x64, seed, n, decades):
    rng = np.random.default_rng(seed)
    matrix, x = spd(rng, n, 10.0**decades), rng.standard_normal(n)
    got = np.asarray(solve(matrix, matrix @ x))
    # As good as LAPACK's solution with pivots, whose error grows with the condition number too.
    lapack = np.abs(np.linalg.solve(matrix, matrix @ x) - x).max()
    assert np.abs(got - x).max() <= 20 * lapack + 1e-14 * 10.0**decades * n


def test_solve_spd_of_a_batch_is_a_loop(x64):
    rng = np.random.default_rng(0)
    matrices, vectors = np.stack([spd(rng, 5) for _ in range(7)]), rng.standard_normal((7, 5))
    together = jax.jit(jax.vmap(cs.solve_spd))(matrices, vectors)
    np.testing.assert_allclose(together, np.linalg.solve(matrices, vectors[..., None])[..., 0], rtol=1e-11)
    matrices[2, 0, 0] = np.nan
    poisoned = np.asarray(jax.jit(jax.vmap(cs.solve_spd))(matrices, vectors))
    assert np.isnan(poisoned[2]).all()
    np.testing.assert_array_equal(np.delete(poisoned, 2, 0), np.delete(together, 2, 0))


# --- The minimum ------------------------------------------------------------------------------------------------------


def brute_force(mass, force, rows):
    """The one way to have each row at its lower bound, at its upper or between them that is consistent."""
    found = []
    choices = [
        [0] + [-1] * int(np.isfinite(lo)) + [1] * int(np.isfinite(up))
        for lo, up in zip(rows.lower, rows.upper, strict=True)
    ]
    for side in map(np.array, itertools.product(*choices)):
        fixed = np.where(side < 0, rows.lower, np.where(side > 0, rows.upper, 0.0))
        D = np.where(side == 0, rows.stiffness, 0.0)
        H = mass + rows.jacobian.T @ (D[:, None] * rows.jacobian)
        a = np.linalg.solve(H, force + rows.jacobian.T @ (D * rows.target + np.where(side == 0, 0.0, fixed)))
        f = -rows.stiffness * (rows.jacobian @ a - rows.target)
        between = (f > rows.lower) & (f < rows.upper)
        if np.all(np.where(side == 0, between, np.where(side < 0, f <= rows.lower, f >= rows.upper))):
            found.append(a)
    (only,) = found
    return only


@functools.partial(jax.jit, static_argnames=("max_iterations", "num_bounded"))
def accelerations(mass, force, rows, start, max_iterations=50, num_bounded=4):
    return solved(mass, force, rows, start, max_iterations, num_bounded)[0]


@functools.partial(jax.jit, static_argnums=(4, 5))
def solved(mass, force, rows, start, max_iterations, num_bounded):
    return cs.solve_accelerations(mass, force, rows, start, max_iterations=max_iterations, num_bounded=num_bounded)


@given(seed=SEEDS)
def test_the_solution_is_the_brute_force_minimum(x64, seed):
    mass, force, rows, start = problem(seed, 4, SIX)
    expected = brute_force(mass, force, rows)
    for begin in (start, np.zeros(4), 1e3 * start, expected):
        np.testing.assert_allclose(accelerations(mass, force, rows, begin), expected, rtol=1e-9, atol=1e-9)
    here = cost(mass, force, rows, expected)
    rng = np.random.default_rng(seed)
    for size in (1e-3, 1.0):
        assert here < min(cost(mass, force, rows, expected + size * rng.standard_normal(4)) for _ in range(20))


MANY = ["equality"] * 3 + ["friction"] * 7 + ["contact"] * 30


@given(seed=SEEDS)
def test_forces_balance_with_many_rows(x64, seed):
    """More rows than unknowns and stiffnesses over six decades; a dozen of Newton's steps suffice."""
    mass, force, rows, start = problem(seed, 8, MANY, spread=5.0)
    a = np.asarray(accelerations(mass, force, rows, start, max_iterations=25, num_bounded=10))
    f = np.asarray(cs.row_forces(rows, jnp.asarray(a)))
    np.testing.assert_array_less(rows.lower - 1e-15, f)
    np.testing.assert_array_less(f, rows.upper + 1e-15)
    scale = np.abs(mass) @ np.abs(a) + np.abs(rows.jacobian.T) @ np.abs(rows.stiffness * rows.target + f)
    np.testing.assert_array_less(np.abs(mass @ a - force - rows.jacobian.T @ f), 1e-10 * scale.max())


def test_a_row_that_goes_from_one_bound_to_the_other(x64):
    """Dry friction that turns around within one Newton step is clipped before and after, but is not solved yet."""
    rows = Rows(*(np.array(x) for x in ([[1.0, 1.0]], [100.0], [0.0], [-1.0], [1.0])))
    mass, force = np.diag([1.0, 4.0]), np.array([-3.0, 0.0])
    for start in ([-2.0, 3.0], [1.0, 3.0], [4.0, -1.0], [4.0, 3.0]):
        got = accelerations(mass, force, rows, np.array(start), num_bounded=1)
        np.testing.assert_allclose(got, [-2.0, 0.25], rtol=1e-14)


def test_friction_that_holds_and_friction_that_is_none(x64):
    rows = Rows(*(np.array(x) for x in ([[1.0]], [1e6], [0.0], [-2.0], [2.0])))
    got = accelerations(np.eye(1), np.array([1.9]), rows, np.array([7.0]), num_bounded=1)
    np.testing.assert_allclose(got, [1.9 / (1.0 + 1e6)], rtol=1e-9)
    none = rows._replace(lower=np.zeros(1), upper=np.zeros(1))
    for force in (1.9, 0.0):
        got = accelerations(np.eye(1), np.array([force]), none, np.zeros(1), num_bounded=1)
        np.testing.assert_allclose(got, [force], rtol=1e-14)
        np.testing.assert_array_equal(cs.curvature(jnp.eye(1), none, got), np.eye(1))


def test_without_rows_it_is_a_linear_system(x64):
    rng = np.random.default_rng(0)
    mass, force, empty = spd(rng, 5), rng.standard_normal(5), np.zeros(0)
    rows = Rows(np.zeros((0, 5)), empty, empty, empty, empty)
    got = accelerations(mass, force, rows, np.zeros(5), num_bounded=0)
    np.testing.assert_allclose(got, np.linalg.solve(mass, force), rtol=1e-11)


def test_the_number_of_steps_is_bounded(x64):
    """One step leaves it unsolved; a NaN does not run for ever and stays in its own env."""
    mass, force, rows, start = problem(3, 8, MANY)
    end = accelerations(mass, force, rows, start, num_bounded=10)
    one = accelerations(mass, force, rows, start, max_iterations=1, num_bounded=10)
    assert np.abs(end - one).max() > 1e-3
    assert [float(solved(mass, force, rows, start, n, 10)[1]) for n in (50, 1)] == [0.0, 1.0]
    starts = np.stack([start, start, 2.0 * start])
    forces = np.stack([force, np.full(8, np.nan), force])
    many = jax.jit(jax.vmap(lambda f, s: accelerations(mass, f, rows, s, num_bounded=10)))(forces, starts)
    assert np.isnan(many[1]).all()
    for env in (0, 2):
        np.testing.assert_allclose(many[env], end, rtol=1e-10)


# --- The derivative ---------------------------------------------------------------------------------------------------


def solution(arguments, start):
    """The accelerations with the derivative of the implicit function theorem."""
    mass, force, rows = arguments
    a = accelerations(*jax.lax.stop_gradient((mass, force, rows, start)))
    residual = mass @ a - force - rows.jacobian.T @ cs.row_forces(rows, a)
    return a - cs.implicit_correction(cs.curvature(mass, rows, a), residual)


COTANGENT = np.array([0.7, -1.3, 0.4, 1.1])


@pytest.fixture(scope="module")
def solution_and_derivatives(derivatives):
    program = derivatives(lambda x: solution(x[:3], x[3]))

    def weights(_):
        return jnp.asarray(COTANGENT)

    return lambda x, move: program(x, move, weights=weights)


@given(seed=SEEDS)
def test_derivative_of_the_solution(x64, random_like, central_difference, inner, solution_and_derivatives, seed):
    """With respect to masses, forces, Jacobian, stiffness, target and bounds; none with respect to the start."""
    mass, force, rows, start = problem(seed, 4, SIX, spread=2.0)
    x = jax.tree.map(jnp.asarray, (mass, force, rows, start))
    move = jax.tree.map(lambda a, m: jnp.where(jnp.isfinite(a), m, 0.0), x, random_like(seed, x))
    move = (move[0] + move[0].T, *move[1:])
    value, forward, _, gradient = solution_and_derivatives(x, move)
    np.testing.assert_allclose(value, brute_force(mass, force, rows), rtol=1e-8, atol=1e-9)
    assert inner(forward, COTANGENT) == pytest.approx(inner(gradient, move), rel=1e-10)
    np.testing.assert_array_equal(gradient[3], 0.0)
    difference = central_difference(lambda x: accelerations(*x), x, move, 1e-7)
    np.testing.assert_allclose(forward, difference, rtol=1e-5, atol=1e-6 * max(1.0, np.abs(difference).max()))


def test_a_direction_that_is_zero_at_the_solution(x64):
    """Started at the solution, with a row that has just left its bound: no 0 / 0."""
    mass, force, rows, _ = problem(5, 4, SIX)
    a = accelerations(mass, force, rows, np.zeros(4))
    np.testing.assert_allclose(accelerations(mass, force, rows, a), a, rtol=1e-12)
    still = rows._replace(target=np.zeros(len(rows.target)))
    np.testing.assert_array_equal(accelerations(mass, np.zeros(4), still, np.zeros(4)), np.zeros(4))


def test_the_solution_inside_shard_map(x64):
    mass, force, rows, start = problem(0, 4, ["friction", "contact"])
    solve = functools.partial(cs.solve_accelerations, max_iterations=5, num_bounded=1)
    assert [a.shape for a in traced_under_shard_map(solve, mass, force, rows, start)] == [(1, 4), (1,)]
