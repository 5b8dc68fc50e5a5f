"""The box of nodes: where they lie, how they are counted, where particles can be, what is refused."""

import numpy as np
import pytest

from rewax.physics.mpm.grid import Grid

GRID = Grid(shape=(4, 6, 5), spacing=0.5, origin=(-1.0, 2.0, 0.25))


def test_nodes_lie_at_multiples_of_the_spacing():
    np.testing.assert_array_equal(GRID.axis_nodes(0), [-1.0, -0.5, 0.0, 0.5])
    np.testing.assert_array_equal(GRID.axis_nodes(1), [2.0, 2.5, 3.0, 3.5, 4.0, 4.5])
    np.testing.assert_array_equal(GRID.axis_nodes(2), [0.25, 0.75, 1.25, 1.75, 2.25])
    assert Grid(shape=(4, 4, 4), spacing=1.0).origin == (0.0, 0.0, 0.0)


def test_particles_stay_half_a_cell_inside_the_outermost_nodes():
    assert GRID.lower == (-0.75, 2.25, 0.5)
    assert GRID.upper == (0.25, 4.25, 2.0)


def test_flat_indices_count_along_z_first():
    """As NumPy's arrays of this shape."""
    assert GRID.num_nodes == 120 and GRID.num_columns == 24
    for index in np.ndindex(GRID.shape):
        assert np.dot(GRID.strides, index) == np.ravel_multi_index(index, GRID.shape)


def test_equal_grids_are_one_program():
    again = Grid(shape=(4, 6, 5), spacing=0.5, origin=(-1.0, 2.0, 0.25))
    assert again == GRID and hash(again) == hash(GRID)
    assert Grid(shape=(4, 6, 5), spacing=0.25, origin=GRID.origin) != GRID


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shape": (4, 3, 5)}, r"Grid\.shape\[1\] is 3: .* at least 4"),
        ({"shape": (4, 4)}, r"Grid.shape is \(4, 4\).* three numbers"),
        ({"spacing": 0.0}, "Grid.spacing is 0.0.* positive"),
        ({"spacing": -0.1}, "Grid.spacing is -0.1.* positive"),
        ({"spacing": float("nan")}, "Grid.spacing is nan.* positive"),
        ({"spacing": float("inf")}, "Grid.spacing is inf.* positive"),
    ],
)
def test_impossible_grids_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Grid(**({"shape": (4, 6, 5), "spacing": 0.5} | changes))
