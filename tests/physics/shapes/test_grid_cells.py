"""Cells of a grid: on nodes, between them, beyond, and where a number is NaN."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.shapes.grid_cells import check_nodes, locate, take


def test_places_in_cells():
    """Four nodes from 1 in steps of 0.5: cells 0 to 2."""
    x = jnp.array([0.0, 1.0, 1.25, 1.5, 2.4, 2.5, 3.0])
    cell, within, beyond = locate(x, 1.0, 0.5, 4)
    np.testing.assert_array_equal(cell, [0, 0, 0, 1, 2, 2, 2])
    np.testing.assert_allclose(within, [0, 0, 0.5, 0, 0.8, 1, 1], atol=1e-6)
    np.testing.assert_allclose(beyond, [-2, 0, 0, 0, 0, 0, 1], atol=1e-6)
    slope = jax.grad(lambda origin: locate(x, origin, 0.5, 4)[1][2])(1.0)
    np.testing.assert_allclose(slope, -2.0)
    for x in (1.0, 2.5):  # an end has the derivative of the inside
        assert float(jax.grad(lambda x: locate(x, 1.0, 0.5, 4)[1])(x)) == 2.0
        assert float(jax.grad(lambda x: locate(x, 1.0, 0.5, 4)[2])(x)) == 0.0


def test_nan_has_a_legal_cell():
    cell, within, _ = locate(jnp.array([jnp.nan]), 1.0, 0.5, 4)
    assert 0 <= int(cell[0]) <= 2 and np.isnan(within[0]) and take(jnp.arange(4.0), cell).shape == (1,)


@pytest.mark.parametrize(("shape", "axes"), [((3,), "xz"), ((3, 1), "xz"), ((2, 2), "xyz")])
def test_grids_without_cells_are_refused(shape, axes):
    check_nodes("heights", (2, 2, 2)[: len(axes)], axes)
    with pytest.raises(ValueError, match=f"^heights has shape .*: give at least two nodes along each of {axes[0]}, "):
        check_nodes("heights", shape, axes)
