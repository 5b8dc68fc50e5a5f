"""The line search of the constraint solver: the least cost along a direction, in the form of each platform."""

import jax
import numpy as np
import pytest
from constraint_problems import SIX, cost, problem, spd
from hypothesis import given
from hypothesis import strategies as st
from native_cases import NEEDS_COMPILER

from rewax.lowering import interpreted, recorded
from rewax.physics.rigid import line_search as ls
from rewax.physics.rigid.line_search import Rows
from rewax.physics.rigid.solver import solve_accelerations

SEEDS = st.integers(0, 10**6)


def searched(form):
    return jax.jit(lambda rows, missed, change, slope, curve: form(4, (*rows[1:], missed, change, slope, curve), ())[0])


SEARCHES = {"at all kinks": searched(ls._at_all_kinks), "piece by piece": searched(ls._piece_by_piece)}
"""The form that XLA compiles, and the form that the machine runs."""
BOTH = pytest.mark.parametrize("line_search", SEARCHES.values(), ids=SEARCHES.keys())


@BOTH
@given(seed=SEEDS, size=st.sampled_from([0.01, 1.0, 100.0]))
def test_the_line_search_finds_the_least_cost(x64, line_search, seed, size):
    """Against a grid that is refined around its best point until nothing is left."""
    mass, force, rows, start = problem(seed, 4, SIX)
    rng = np.random.default_rng(seed + 1)
    missed = rows.jacobian @ start - rows.target
    gradient = mass @ start - force - rows.jacobian.T @ np.clip(-rows.stiffness * missed, rows.lower, rows.upper)
    direction = -size * spd(rng, 4) @ gradient  # downhill
    length = float(
        line_search(rows, missed, rows.jacobian @ direction, direction @ gradient, direction @ mass @ direction)
    )
    low, high = 0.0, 1.0
    while cost(mass, force, rows, start + high * direction) < cost(mass, force, rows, start + 0.5 * high * direction):
        high *= 2.0
    for _ in range(60):
        grid = np.linspace(low, high, 21)
        best = int(np.argmin([cost(mass, force, rows, start + t * direction) for t in grid]))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, 20)]
        if high - low < 1e-7 * high:
            break
    # The cost is flat at its least: half of the digits.
    assert length == pytest.approx(0.5 * (low + high), rel=1e-5)

    def slope_at(t):
        a = start + t * direction
        f = np.clip(-rows.stiffness * (rows.jacobian @ a - rows.target), rows.lower, rows.upper)
        return direction @ (mass @ a - force - rows.jacobian.T @ f)

    assert abs(slope_at(length)) < 1e-9 * abs(slope_at(0.0))


@BOTH
def test_the_line_search_ends_on_a_kink(x64, line_search):
    """Where the derivative jumps in effect (a row so stiff that it is a step), and beyond the last kink."""
    steep = Rows(*(np.array(x) for x in ([[1.0]], [1e12], [0.0], [0.0], [np.inf])))
    got = line_search(steep, np.array([2.0]), np.array([-1.0]), np.array(-1.0), np.array(0.1))
    np.testing.assert_allclose(got, 2.0, rtol=1e-9)
    leaving = Rows(*(np.array(x) for x in ([[1.0]], [5.0], [0.0], [0.0], [np.inf])))
    # -s + t / 2 + min(5 t, 10) is zero:
    for s, length in ((5.5, 1.0), (20.0, 20.0)):
        got = line_search(leaving, np.array([-2.0]), np.array([1.0]), np.array(-s), np.array(0.5))
        np.testing.assert_allclose(got, length, rtol=1e-14)


@BOTH
def test_the_line_search_stays_where_there_is_no_direction(x64, line_search):
    rows = Rows(*(np.array(x) for x in ([[1.0]], [5.0], [0.0], [0.0], [np.inf])))
    assert float(line_search(rows, np.array([1.0]), np.zeros(1), np.array(0.0), np.array(0.0))) == 0.0


@NEEDS_COMPILER
def test_the_solver_in_cpp_ends_where_it_ends_in_xla(x64):
    """Problems of a batch with other numbers of Newton steps and of turns of the line search."""
    mass, force, rows, start = jax.tree.map(lambda *a: np.stack(a), *(problem(seed, 4, SIX) for seed in range(100)))

    def solution(mass, force, rows, start):
        return solve_accelerations(mass, force, rows, start, max_iterations=50, num_bounded=4)

    with recorded() as decisions:
        found = jax.jit(jax.vmap(interpreted(solution)))(mass, force, rows, start)
    assert [decision.reason for decision in decisions] == [None]
    assert not np.any(found[1])
    np.testing.assert_allclose(found[0], jax.jit(jax.vmap(solution))(mass, force, rows, start)[0], rtol=1e-9, atol=1e-9)
