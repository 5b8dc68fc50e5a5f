"""Corners of elements and sums at vertices: transposed, by hand, and equal when their indices are."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.thin.stencils import Stencil, corners, scatter

STENCIL = Stencil(np.asarray([[0, 1, 2], [2, 1, 3]]), 4)


def test_corners_by_hand_and_their_transpose():
    x = tuple(jnp.arange(4.0) + 10 * i for i in range(3))
    found = corners(STENCIL, x)
    np.testing.assert_array_equal(found[2], [[2, 3], [12, 13], [22, 23]])
    y = tuple(tuple(jnp.asarray([1.0 + k, 5.0 - k + i]) for i in range(3)) for k in range(3))
    summed = scatter(STENCIL, y)
    np.testing.assert_array_equal(summed[0], [1, 2 + 4, 3 + 5, 3])
    inner = lambda a, b: sum(float(jnp.sum(p * q)) for p, q in zip(*map(jax.tree.leaves, (a, b)), strict=True))  # noqa: E731
    assert inner(found, y) == inner(x, summed)
    (pulled,) = jax.vjp(lambda x: corners(STENCIL, x), x)[1](y)
    for a, b in zip(pulled, summed, strict=True):
        np.testing.assert_array_equal(a, b)


def test_stencils_compare_by_their_indices():
    same, other = Stencil(np.asarray([[0, 1, 2], [2, 1, 3]]), 4), Stencil(np.asarray([[0, 1, 2], [1, 2, 3]]), 4)
    assert same == STENCIL and hash(same) == hash(STENCIL) and len(same) == 2
    assert other != STENCIL and Stencil(same.indices, 5) != STENCIL
