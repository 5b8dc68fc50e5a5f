"""Structural zeros: entries of tables and matrices that are always zero."""

from typing import TypeVar

import jax

from rewax.lowering.linear_primitive import Arrays, linear_call

T = TypeVar("T")


def structural_zeros(tree: T) -> T:
    """The same arrays; lowered programs omit their constant zeros from products and sums.

    A lowered program computes the product of a constant zero and x, because it is NaN if x is infinite or NaN. Mark an
    index table or a sparse matrix, and products with its zeros are zero for any x and cost nothing. Only zeros that are
    constants in the program count, and only in operations on the marked arrays.

    Args:
      tree: arrays of floating-point numbers.

    Gradient: exact (the identity), forward and reverse.
    """
    leaves, treedef = jax.tree.flatten(tree)
    shapes = [jax.typeof(a) for a in leaves]
    return jax.tree.unflatten(treedef, linear_call(_mark, _mark, None, (), leaves, like=shapes))


def marks_structural_zeros(function: object) -> bool:
    """Whether the function of a ``linear_call`` is the one of ``structural_zeros``."""
    return function is _mark


def _mark(static: None, residuals: Arrays, arrays: Arrays) -> Arrays:
    del static, residuals
    return arrays
