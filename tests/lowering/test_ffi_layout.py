"""Arguments on their way into C++."""

import jax.numpy as jnp
import numpy as np
import pytest

from rewax.lowering.ffi_layout import Operand, batch_shape


@pytest.mark.parametrize(
    ("shape", "present", "step", "laid_out"),
    [
        ((2, 3, 4), (True, True), 4, (2, 3, 4)),
        ((3, 4), (False, True), 4, (2, 3, 4)),  # repeated along the outer axis
        ((4,), (False, False), 0, (4,)),  # the same for all
    ],
)
def test_where_copies_lie(shape, present, step, laid_out):
    """The last axis is the array's own."""
    operand = Operand(jnp.arange(np.prod(shape)).reshape(shape), False, present)
    assert operand.own_shape == (4,)
    assert operand.step == step
    found = operand.laid_out((2, 3))
    assert found.shape == laid_out
    np.testing.assert_array_equal(jnp.broadcast_to(found, (2, 3, 4)), jnp.broadcast_to(operand.array, (2, 3, 4)))


def test_the_batch_is_that_of_all_operands():
    of_one_axis = Operand(jnp.zeros((5, 2)), False, (True, False))
    of_other = Operand(jnp.zeros((7, 2)), False, (False, True))
    assert batch_shape([of_one_axis, of_other]) == (5, 7)
