"""Loops whose number of turns depends on their values, with one batch element per lane."""

import operator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER

from rewax.lowering import interpreted, recorded
from rewax.lowering.from_jaxpr import from_jaxpr
from rewax.lowering.lane_assembler import assemble
from rewax.lowering.operations import UnsupportedError

pytestmark = NEEDS_COMPILER
X = jnp.linspace(0.1, 40.0, 37)
"""More than two vectors of batch elements, which need different numbers of turns."""


def same_as_jax(function, *args):
    """The results of a function for a batch, in C++, after a comparison with JAX."""
    with recorded() as decisions:
        found = jax.jit(jax.vmap(interpreted(function)))(*args)
    assert [decision.reason for decision in decisions] == [None]
    expected = jax.jit(jax.vmap(function))(*args)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=5e-6, atol=1e-6), found, expected)
    return found


def square_root(x):
    """Heron's method."""
    return jax.lax.while_loop(
        lambda s: (jnp.abs(s[0] * s[0] - x) > 1e-5 * x) & (s[1] < 50),
        lambda s: (0.5 * (s[0] + x / s[0]), s[1] + 1),
        (x, 0),
    )[0]


def test_each_lane_takes_as_many_turns_as_it_needs():
    np.testing.assert_allclose(same_as_jax(square_root, X), jnp.sqrt(X), rtol=1e-5)


def test_the_derivative_of_a_loop():
    with recorded() as decisions:
        slope = jax.jit(jax.vmap(lambda x: jax.jvp(interpreted(square_root), (x,), (2.0,))[1]))(X)
    assert [(decision.rule, decision.reason) for decision in decisions] == [("tangent", None)]
    np.testing.assert_allclose(slope, 1.0 / jnp.sqrt(X), rtol=2e-3)


def test_values_that_change_places():
    """All values of the next turn follow from those of this one."""

    def function(x):
        a, b, limit, turns = jax.lax.while_loop(
            lambda s: s[3] < s[2], lambda s: (s[1], s[0] + jnp.sin(x), s[2], s[3] + 1.0), (x, 2.0 * x, x, 0.0 * x)
        )
        return a, b - limit, turns, jnp.sin(x)

    same_as_jax(function, X)


def test_a_loop_without_a_turn():
    """What only the loop computes has a value, too, where no turn is taken."""

    def function(x):
        last = jax.lax.while_loop(lambda s: s > 20.0, lambda s: s * (0.5 + 0.1 * jnp.cos(x)), x)
        return last, 0.1 * jnp.cos(x), last * jnp.cos(x)

    same_as_jax(function, X)
    np.testing.assert_array_equal(same_as_jax(function, jnp.array([1.0, 2.0]))[0], [1.0, 2.0])


def test_values_after_a_loop_are_not_those_of_its_last_turn():
    """The same expression, of the value in the loop and of the value after it."""

    def function(x):
        last = jax.lax.while_loop(lambda s: jnp.sin(s) * s < 5.0, lambda s: s + 0.1 * jnp.abs(jnp.sin(s) * s) + 0.7, x)
        return jnp.sin(last) * last

    same_as_jax(function, X)


def test_integers_and_booleans():
    def function(x):
        a, going, turns = jax.lax.while_loop(
            lambda s: s[1] & (s[2] < 20), lambda s: (s[0] * 1.1, s[0] * 1.1 < 30.0, s[2] + 1), (x, x > 1.0, 0)
        )
        return a, going.astype(x.dtype), turns.astype(x.dtype)

    same_as_jax(function, X)
    same_as_jax(lambda x: jax.lax.fori_loop(0, x.astype(int), lambda i, s: 0.5 * s + jnp.cos(x) * i, x), X)


def test_loops_in_loops_and_after_loops():
    def function(x):
        def turn(s):
            a, b = jax.lax.while_loop(lambda u: u[0] > s[0], lambda u: (0.7 * u[0], u[1] + s[0]), (x + s[0], s[1]))
            _, c = jax.lax.while_loop(lambda u: u[0] < s[0] + 5.0, lambda u: (u[0] + 1.0, u[1] + a), (s[0], b))
            return 2.0 * s[0] + 0.1, 0.9 * c + jnp.sin(s[1]) + a

        first = jax.lax.while_loop(lambda s: s[0] < 3.0 * x, turn, (0.0 * x + 0.5, x))
        return first, jax.lax.while_loop(
            lambda s: s[0] > 0.1 * first[0], lambda s: (0.5 * s[0], s[1] + jnp.sin(first[1])), first
        )

    same_as_jax(function, X)


def test_no_element_waits_for_ever_for_one_that_is_not_there():
    """Lanes beyond the last element of the batch end with it."""
    for count in (1, 3, 17):
        same_as_jax(square_root, X[:count])


def test_a_value_that_is_not_finite_ends_as_in_jax():
    same_as_jax(square_root, jnp.array([jnp.nan, 4.0, jnp.inf]))


@pytest.mark.parametrize("seed", range(12))
def test_random_loops(seed):
    """Bodies of random operations on carried values, constants and values from before the loop."""
    random = np.random.default_rng(seed)
    num_carried, num_operations = random.integers(1, 5), random.integers(3, 25)
    binary = (operator.add, operator.sub, operator.mul, jnp.maximum, jnp.minimum)
    unary = (jnp.sin, jnp.tanh, jnp.abs, lambda a: jnp.where(a > 0.3, a, -0.5))
    plan = [
        (random.integers(2), random.integers(5), random.integers(4), *random.integers(100, size=2))
        for _ in range(num_operations)
    ]
    wanted = random.integers(100, size=num_carried + 2)

    def grown(values):
        for is_unary, b, u, i, j in plan:
            one, other = values[i % len(values)], values[j % len(values)]
            values = [*values, unary[u](one) if is_unary else jnp.tanh(binary[b](one, other))]
        return values

    def function(x):
        before = grown([x, 0.3 * x])

        def turn(s):
            values = grown([*s[1], x, before[-1], before[wanted[-1] % len(before)]])
            return s[0] + 0.3, tuple(values[k % len(values)] for k in wanted[:num_carried])

        start = tuple(before[k % len(before)] for k in wanted[:num_carried])
        turns, last = jax.lax.while_loop(lambda s: (s[0] < x) & (jnp.abs(s[1][0]) < 5.0), turn, (0.0 * x, start))
        return turns, last, grown([x, last[0], before[-1]])[-1]

    same_as_jax(function, jnp.linspace(0.0, 3.0, 21))


def test_registers_hold_only_what_is_read_again():
    """A long body needs few registers; what a loop reads from before it stays until the loop ends."""

    def function(x):
        def turn(s):
            for _ in range(100):
                s = 0.5 * jnp.sin(s) + x
            return s

        return jax.lax.while_loop(lambda s: s < 0.9 * x, turn, 0.0 * x)

    listing = from_jaxpr(jax.make_jaxpr(function)(1.0), [True], loops=True)
    assert assemble(listing, [np.dtype(np.float32)]).num_registers <= 10


def test_what_does_not_change_is_computed_before_the_loop():
    def function(x):
        return jax.lax.while_loop(lambda s: s < 10.0 * x, lambda s: s + jnp.exp(x), x)

    listing = from_jaxpr(jax.make_jaxpr(function)(1.0), [True], loops=True)
    places = {operation.name: operation.place for operation in listing.operations}
    assert places["exp"] == () and places["add"] == (1,) and places["result"] == (2,)


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda x: jax.lax.while_loop(lambda s: x < 1.0, lambda s: s + 1.0, x), "a condition that does not change"),
        (lambda x: jax.lax.while_loop(lambda s: jnp.sum(jnp.sort(s)) < 1.0, lambda s: s + 1.0, x + jnp.ones(3)), "sort"),
        (lambda x: jax.lax.cond(x > 0.0, lambda z: jax.lax.while_loop(lambda s: s < 9.0, lambda s: 2.0 * s, z), jnp.sin, x),
         "it has a while loop in a branch of a condition"),
    ],
)  # fmt: skip
def test_refusals(function, reason):
    with pytest.raises(UnsupportedError, match=reason):
        from_jaxpr(jax.make_jaxpr(function)(1.0), [True], loops=True)
