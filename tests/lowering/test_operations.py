"""Lists of operations: each once, constants folded, zeros and ones left out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER
from operation_cases import assert_equal_to_jax

from rewax.lowering import interpreted, recorded
from rewax.lowering.from_jaxpr import from_jaxpr
from rewax.lowering.operations import Operation, UnsupportedError
from rewax.lowering.structural import structural_zeros


def test_an_operation_is_there_once():
    line = from_jaxpr(jax.make_jaxpr(lambda a: (jnp.sqrt(a) * jnp.sqrt(a), 1.0 * a + 0.0))(jnp.ones(1)), [True])
    assert line.operations.count(Operation("sqrt", (0,), "f", False)) == 1
    assert line.outputs[1] == [0]


def counted(program):
    """Names of the operations of a program of three numbers."""
    line = from_jaxpr(jax.make_jaxpr(program)(jnp.ones(3)), [True])
    return sorted(o.name for o in line.operations if o.name not in ("input", "constant"))


def test_structural_zeros_and_ones_cost_nothing():
    table = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0]], np.float32)
    assert counted(lambda a: (structural_zeros(jnp.asarray(table)) @ a, (a - 0.0) / 1.0)) == ["add"]

    def transposed(a):
        return jax.vjp(lambda a: structural_zeros(jnp.asarray(table)) @ a, a)[1](a[:2])

    assert counted(transposed) == []  # each column has one 1, and no result needs the product itself


def test_other_zeros_are_computed():
    """They make NaN of what is infinite, as in JAX."""
    table = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    assert counted(lambda a: table @ a) == ["add"] * 4 + ["mul"] * 3
    assert counted(lambda a: 0.0 / a) == ["div"] * 3


def test_a_division_by_zero_is_one():
    line = from_jaxpr(jax.make_jaxpr(lambda a: a / 0.0)(jnp.ones(1)), [True])
    assert line.operations[line.outputs[0][0]].name == "div"


def test_what_is_computed_of_constants_is_a_constant():
    line = from_jaxpr(jax.make_jaxpr(lambda a: jnp.where(np.arange(4) % 2 == 1, a, -a))(jnp.ones(4)), [True])
    assert sum(o.name == "neg" for o in line.operations) == 4
    assert [line.operations[i].name for i in line.outputs[0]] == ["neg", "input", "neg", "input"]


def integers(a, b):
    """Operations whose results are integers or booleans."""
    c = jnp.array([3, -2, 5])
    return [
        b * number.astype(a.dtype)
        for number in (c & 6, c | 8, c ^ 5, ~c, c // 2, c % 3, jax.lax.div(c, 2), jax.lax.rem(c, 2), (c & 1) == 1)
    ]


def test_integers_are_not_booleans():
    assert_equal_to_jax(integers, 3)


def test_integers_of_a_program_wrap_and_divide_as_in_jax():
    def program(a, b):
        c = jnp.array([3, -7, 2**31 - 1], jnp.int32)
        numbers = (c * 2**30, c + c, jax.lax.div(c, 0), jax.lax.rem(c, 0), -(c - 2**30) * 3, c**3)
        return [b * number.astype(a.dtype) for number in numbers]

    assert_equal_to_jax(program, 4)


@pytest.mark.parametrize(
    ("program", "named"),
    [
        (lambda a: a * jnp.array([3], jnp.int32).astype(jnp.uint8).astype(a.dtype), "numbers of type uint8"),
    ],
)
def test_which_integers_are_refused(program, named):
    with pytest.raises(UnsupportedError, match=named):
        from_jaxpr(jax.make_jaxpr(lambda a: program(a))(jnp.ones(1)), [True])


@NEEDS_COMPILER
def test_the_derivative_of_a_scatter_that_may_overwrite_itself():
    """JAX numbers its updates by unsigned integers to find those that remain."""

    def program(a):
        return jnp.sum(jnp.sin(a.at[jnp.array([0, 2, 0])].set(a * 2.0)) * a)

    a = jnp.array([0.3, -0.2, 0.7])
    with recorded() as decisions:
        found = jax.grad(interpreted(program))(a), jax.jvp(interpreted(program), (a,), (a,))[1]
    assert not [d for d in decisions if d.reason]
    np.testing.assert_allclose(found[0], jax.grad(program)(a), rtol=1e-6)
    np.testing.assert_allclose(found[1], jax.jvp(program, (a,), (a,))[1], rtol=1e-6)


@NEEDS_COMPILER
def test_a_product_with_a_boolean_is_a_selection_as_in_xla():
    """The derivative of a minimum multiplies by booleans: an infinite number that is not the minimum does not matter."""

    def least(a):
        return jnp.min(a * a)

    a, direction = jnp.array([0.25, 0.25, jnp.inf]), jnp.array([1.0, -1.0, 0.5])
    expected = jax.jit(lambda a, d: jax.jvp(least, (a,), (d,)))(a, direction)
    np.testing.assert_array_equal(jax.jvp(interpreted(least), (a,), (direction,)), expected)


def test_unsigned_integers_have_32_bits_in_double_precision(x64):
    """Chosen by a condition, they are no constants."""

    def program(a):
        chosen = jnp.where(a > 0, jnp.uint32(1), jnp.uint32(5))
        return jnp.where(~chosen == jnp.uint32(2**32 - 2), a, 2.0 * a)

    a = jnp.array([0.5, -0.5])
    with recorded() as decisions:
        np.testing.assert_array_equal(interpreted(program)(a), program(a))
    assert not [d for d in decisions if d.reason]
