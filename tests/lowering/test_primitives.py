"""Primitives on single numbers: what each is, and which parameters it may have."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER

from rewax.lowering import interpreted, pointwise, report
from rewax.lowering.from_jaxpr import from_jaxpr
from rewax.lowering.primitives import PRIMITIVES

NUMBERS = np.array([0.0, -0.0, 0.3, -0.7, 1.0, 2.5, -3.5, 40.0, np.inf, -np.inf, np.nan, 0.5], np.float32)
FUNCTIONS = {
    "tan": jnp.tan, "arctan": jnp.arctan, "arcsin": jnp.arcsin, "arccos": jnp.arccos, "sinh": jnp.sinh, "cosh": jnp.cosh,
    "arcsinh": jnp.arcsinh, "arccosh": jnp.arccosh, "arctanh": jnp.arctanh, "erf": jax.scipy.special.erf,
    "erfc": jax.scipy.special.erfc, "exp2": jnp.exp2, "round": jnp.round, "remainder": lambda a: a % 0.7,
    "round_away": lambda a: jax.lax.round(a, jax.lax.RoundingMethod.AWAY_FROM_ZERO),
    "rem": lambda a: jax.lax.rem(a, jnp.full_like(a, 0.7)), "cond": lambda a: jax.lax.cond(a > 0, jnp.sin, jnp.cos, a),
    "zero": lambda a: 0.0 * a, "zero_over": lambda a: jnp.float32(0) / a, "over_zero": lambda a: a / 0.0,
    "integers": lambda a: (a * 1e9).astype(jnp.int32).astype(float), "is_finite": lambda a: 1.0 * jnp.isfinite(a),
    "wraps": lambda a: ((a * 1e9).astype(jnp.int32) * 5 + 2**30).astype(float),
    "divides": lambda a: (a.astype(jnp.int32) // 3 + jax.lax.rem(a.astype(jnp.int32), 2)).astype(float),
    "switch": lambda a: jax.lax.switch(jnp.where(a > 0, 2, 0) + (a > 1), [lambda: 1.0, lambda: 2.0, lambda: 3.0]) * a,
    **{f"slope_of_{f.__name__}": jax.grad(f) for f in (jnp.tanh, jnp.arcsin, jnp.arccos, jnp.arctanh, jnp.arctan)},
    "powers": lambda a: jnp.sum(a ** jnp.arange(5)) + a ** jnp.int32(-1),
    "slope_of_powers": jax.grad(lambda a: jnp.sum(a ** jnp.arange(5))),
    "precision": lambda a: jax.lax.reduce_precision(a, 8, 23),
}  # fmt: skip


@NEEDS_COMPILER
@pytest.mark.parametrize("name", FUNCTIONS)
def test_numbers_are_those_of_jax(name):
    function = FUNCTIONS[name]
    expected = jax.jit(jax.vmap(function))(NUMBERS)
    with report.recorded() as decisions:
        by_machine = jax.vmap(interpreted(function))(NUMBERS)
        by_kernel = pointwise(lambda shared, a: jax.vmap(function)(a))(None, jnp.asarray(NUMBERS))
    assert [d.reason for d in decisions] == [None, None]
    for found in (by_machine, by_kernel):
        np.testing.assert_allclose(found, expected, rtol=3e-6, atol=2e-7)


@NEEDS_COMPILER
def test_a_constant_that_no_integer_holds_becomes_the_largest_one():
    def function(a):
        return jnp.maximum(a.astype(jnp.int32), jnp.full(1, 2.0**31, jnp.float32).astype(jnp.int32)).astype(float)

    np.testing.assert_array_equal(jax.jit(interpreted(function))(jnp.array([5.0])), 2.0**31)


@NEEDS_COMPILER
def test_arc_tangents_of_all_quadrants_and_extreme_points():
    draw = np.random.default_rng(0)
    some = np.r_[NUMBERS, -1.0, 3e38, -2e38, 1e38, 1e-37, draw.normal(size=20), 10.0 ** draw.uniform(-30, 30, 20)]
    a, b = (c.ravel().astype(np.float32) for c in np.meshgrid(some, some))
    found = np.asarray(pointwise(lambda shared, given: jnp.arctan2(*given))(None, (jnp.asarray(a), jnp.asarray(b))))
    expected = np.arctan2(a.astype(float), b.astype(float))
    seen = np.abs(expected) > 1e-37  # smaller numbers may be flushed to zero
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    np.testing.assert_array_equal(np.signbit(found[~np.isnan(found)]), np.signbit(expected[~np.isnan(found)]))
    error = np.abs(found.astype(float) - expected) / np.spacing(np.abs(expected).astype(np.float32))
    assert np.nanmax(error[seen]) < 3.0


@NEEDS_COMPILER
def test_the_derivatives_of_a_law_with_a_tangent_run_in_cpp():
    def law(shared, a):
        return jnp.tan(shared * a)

    def value_jvp_and_vjp(law):
        return law(scale, a), jax.jvp(law, (scale, a), (scale, jnp.cos(a)))[1], jax.vjp(law, scale, a)[1](jnp.sin(a))

    scale, a = jnp.float32(0.7), jnp.asarray(NUMBERS)[:, None]
    with report.recorded() as decisions:
        found = jax.jit(lambda: value_jvp_and_vjp(pointwise(law)))()
    assert [d.reason for d in decisions] == [None, None, None]
    for f, e in zip(jax.tree.leaves(found), jax.tree.leaves(value_jvp_and_vjp(law)), strict=True):
        np.testing.assert_allclose(f, e, rtol=3e-6, atol=1e-7)


@NEEDS_COMPILER
@pytest.mark.parametrize("dtype", [jnp.int32, jnp.int64])
def test_conversions_and_integers_of_both_widths(x64, dtype):
    numbers = np.array([2147483600.0, 2147483647.5, 3e9, -3e9, 1e19, -1e19, np.nan, 7.9, -7.9, 2.0**40])

    def function(a):
        integers = a.astype(dtype)
        return (
            integers.astype(float),
            (integers * 3 + 1).astype(float),
            (integers.astype(jnp.int32) - 5).astype(float),
        )

    for found in (
        jax.vmap(interpreted(function))(numbers),
        pointwise(lambda _, a: function(a))(None, jnp.asarray(numbers)),
    ):
        for a, b in zip(found, jax.jit(jax.vmap(function))(numbers), strict=True):
            np.testing.assert_array_equal(a, b)


def test_every_parameter_of_jax_is_known():
    """A parameter that is not listed is refused, which costs the C++."""
    a = jnp.ones((2, 3))
    for function in (
        jnp.sum,
        jnp.exp,
        jnp.sqrt,
        lambda a: a.at[0].add(1.0),
        lambda a: a @ a.T,
        lambda a: a[jnp.array([1])],
    ):
        from_jaxpr(jax.make_jaxpr(function)(a), [True])
    assert all("jaxpr" not in p.parameters for p in PRIMITIVES.values())
