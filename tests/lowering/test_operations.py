"""Lists of operations: each once, constants folded, zeros and ones left out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from operation_cases import assert_equal_to_jax

from rewax.lowering.from_jaxpr import from_jaxpr
from rewax.lowering.operations import Operation, UnsupportedError


def test_an_operation_is_there_once():
    line = from_jaxpr(jax.make_jaxpr(lambda a: (jnp.sqrt(a) * jnp.sqrt(a), 1.0 * a + 0.0))(jnp.ones(1)), [True])
    assert line.operations.count(Operation("sqrt", (0,), "f", False)) == 1
    assert line.outputs[1] == [0]


def test_zeros_and_ones_of_a_program_cost_nothing():
    """Constant tables, and what derivatives begin with."""
    table = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    line = from_jaxpr(jax.make_jaxpr(lambda a: (table @ a, (a - 0.0) / 1.0, 0.0 / a))(jnp.ones(3)), [True])
    assert [o.name for o in line.operations if o.name not in ("input", "constant")] == ["add"]


def test_a_division_by_zero_is_one():
    line = from_jaxpr(jax.make_jaxpr(lambda a: a / 0.0)(jnp.ones(1)), [True])
    assert line.operations[line.outputs[0][0]].name == "div"


def test_what_is_computed_of_constants_is_a_constant():
    line = from_jaxpr(jax.make_jaxpr(lambda a: jnp.where(np.arange(4) % 2 == 1, a, -a))(jnp.ones(4)), [True])
    assert sum(o.name == "neg" for o in line.operations) == 4
    assert [line.operations[i].name for i in line.outputs[0]] == ["neg", "input", "neg", "input"]


def whole_numbers(a, b):
    """What the whole numbers of a program are known to be."""
    c = jnp.array([3, -2, 5])
    return [
        b * number.astype(a.dtype)
        for number in (c & 6, c | 8, c ^ 5, ~c, c // 2, c % 3, jax.lax.div(c, 2), jax.lax.rem(c, 2), (c & 1) == 1)
    ]


def test_whole_numbers_are_not_truth_values():
    assert_equal_to_jax(whole_numbers, 3)


@pytest.mark.parametrize(
    ("number", "named"),
    [
        (lambda c: c * 2**30, "more than 32 bits"),
        (lambda c: jax.lax.div(c, 0), "divides a whole number by zero"),
        (lambda c: jax.lax.rem(c, 0), "divides a whole number by zero"),
    ],
)
def test_what_whole_numbers_are_refused(number, named):
    program = jax.make_jaxpr(lambda a: a * number(jnp.array([3])).astype(a.dtype))(jnp.ones(1))
    with pytest.raises(UnsupportedError, match=named):
        from_jaxpr(program, [True])
