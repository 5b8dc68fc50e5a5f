"""Bodies of particles, and what every n-th of their points is."""

import numpy as np
import pytest

import rewax
from rewax.envs.kit.soft_parts import lattice_box

CENTER, SIZE = np.array([0.5, 0.1, 0.4]), np.array([0.3, 0.12, 0.2])


@pytest.mark.parametrize("counts", [(8, 8, 8), (8, 5, 10), (3, 1, 7)])
def test_a_lattice_holds_each_cell_once(counts):
    cells = (np.asarray(lattice_box(CENTER, SIZE, counts)) - CENTER) / SIZE * counts + 0.5 * np.asarray(counts) - 0.5
    np.testing.assert_allclose(cells, cells.round(), atol=1e-4)
    assert len(np.unique(cells.round(), axis=0)) == np.prod(counts)
    assert (cells.round().min(0) == 0).all() and (cells.round().max(0) == np.asarray(counts) - 1).all()


@pytest.mark.parametrize("stride", [2, 4, 8, 16])
def test_every_nth_point_of_a_lattice_comes_from_all_of_the_box(stride):
    points = np.asarray(lattice_box(CENTER, SIZE, (8, 8, 8)))
    some = points[::stride]
    np.testing.assert_allclose(some.mean(0), points.mean(0), atol=0.07 * SIZE.max())
    np.testing.assert_allclose(np.ptp(some, axis=0), np.ptp(points, axis=0), rtol=1e-5)
    np.testing.assert_allclose(some.std(0), points.std(0), rtol=0.05)


@pytest.mark.parametrize("task", ["RollingFlat", "HandFlip", "HandLift", "FluidMove", "GripperLift", "SteerFloat"])
def test_the_observed_points_are_a_sample_of_the_body(task):
    env = rewax.make(task, scale="small")
    points = np.asarray(env.rest_positions)
    some, size = np.asarray(env.cloud.pick(points)), np.ptp(points, axis=0)
    assert (np.ptp(some, axis=0) > 0.9 * size).all()
    np.testing.assert_allclose(some.mean(0), points.mean(0), atol=0.1 * size.max())
