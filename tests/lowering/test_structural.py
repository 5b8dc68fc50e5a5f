"""Structural zeros: left out of lowered programs, the identity everywhere else."""

import jax
import jax.numpy as jnp
import numpy as np
from native_cases import NEEDS_COMPILER

from rewax.lowering import interpreted
from rewax.lowering.structural import structural_zeros

TABLE = np.array([[0.0, 2.0], [1.0, 0.0]], np.float32)


def marked(a):
    return structural_zeros(jnp.asarray(TABLE)) @ a


def test_it_is_the_identity():
    a = jnp.array([3.0, 5.0])
    np.testing.assert_array_equal(structural_zeros({"a": a})["a"], a)
    np.testing.assert_array_equal(jax.jacfwd(structural_zeros)(a), np.eye(2))
    np.testing.assert_array_equal(jax.jacrev(structural_zeros)(a), np.eye(2))
    np.testing.assert_array_equal(jax.vmap(structural_zeros)(TABLE), TABLE)


@NEEDS_COMPILER
def test_only_marked_zeros_leave_an_infinite_number_out():
    a = jnp.array([jnp.inf, 1.0])
    np.testing.assert_array_equal(interpreted(marked)(a), [2.0, np.inf])
    np.testing.assert_array_equal(interpreted(lambda a: jnp.asarray(TABLE) @ a)(a), [np.nan, np.inf])


@NEEDS_COMPILER
def test_derivatives_keep_the_marks():
    a = jnp.array([1.0, 2.0])
    np.testing.assert_array_equal(jax.jacrev(interpreted(marked))(a), TABLE)
    np.testing.assert_array_equal(jax.jacfwd(interpreted(marked))(a), TABLE)
