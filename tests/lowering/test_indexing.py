"""Parts of arrays: sliced, gathered, scattered, padded as JAX does it."""

import jax
import jax.numpy as jnp
import numpy as np
from operation_cases import assert_equal_to_jax


def by_index(a, b):
    """Every operation that reads or writes at constant indices."""
    table = jnp.outer(a, b)
    indices = np.array([[2, 0], [1, 1]])
    batched = jax.vmap(lambda row, k: jax.lax.dynamic_slice(row, (k,), (2,)))(table, np.array([1, 0, 5]))
    return (
        table[indices[:, 0], indices[:, 1]],
        table.at[indices[:, 0], indices[:, 1]].add(a[:2]),
        table.at[1:, ::2].set(7.0),
        table.at[indices[:, 0]].multiply(2.0),
        a.at[np.array([1, 9])].set(5.0, mode="drop"),
        a.at[np.array([1, 9])].get(mode="fill", fill_value=3.0),
        a.at[np.array([1, 9])].get(mode="promise_in_bounds"),
        batched,
        jax.lax.dynamic_update_slice(table, table[:2, :2] * 2, (1, 1)),
        jax.lax.pad(table, jnp.float32(4), ((-1, 2, 1), (1, -1, 0))),
    )


def test_parts_are_those_of_jax():
    assert_equal_to_jax(by_index, 1)


def axes_in_another_order(a, b):
    table = jnp.outer(a, b)
    return (
        jax.lax.reshape(table, (9,), dimensions=(1, 0)),
        jnp.ravel(table, order="F"),
        jnp.reshape(table[:2], (3, 2), order="F"),
        jax.grad(lambda t: jnp.prod(t, 1).sum())(table),
        jnp.tile(table[:2], (2, 1)),
        jnp.tile(a, (2, 3)),
        jnp.vdot(a, a),
        jnp.einsum("ij,ij->", table, table),
        table.at[1].apply(lambda x: x * x),
        table.at[jnp.array([0, 0])].max(0.5),
        table.at[1].min(0.5),
    )


def test_the_order_of_axes_and_functions_of_scatters_are_those_of_jax():
    assert_equal_to_jax(axes_in_another_order, 2)
