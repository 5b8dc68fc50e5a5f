"""Learning curves with intervals, and the picture of a landscape."""

import matplotlib.image
import numpy as np
import pytest

from rewax.statistics import Curve, student_interval
from rewax.viz.curves import _band, _mean, _on_one_grid, curves_with_intervals, landscape_picture


def curve(offset, n=40):
    steps = np.arange(1.0, n + 1) * 10
    return Curve(steps, offset + np.log(steps))


def test_curves_are_drawn_for_any_number_of_seeds(tmp_path):
    nothing = Curve(np.zeros(0), np.zeros(0))
    runs = {"sapo": [curve(0.0), curve(1.0), curve(2.0, 30)], "shac": [curve(3.0), nothing], "never": []}
    path = curves_with_intervals(runs, tmp_path / "a.png", title="Task", levels={"no action": 2.0})
    assert matplotlib.image.imread(path).std() > 0.05


def test_the_landscape_is_drawn(tmp_path):
    offsets = np.linspace(-1.0, 1.0, 5)
    hill = -(offsets[:, None] ** 2) - 2.0 * offsets**2
    hill[0, 0] = np.nan  # a policy may fail somewhere
    picture = matplotlib.image.imread(landscape_picture(offsets, hill, tmp_path / "b.png"))
    assert picture.std() > 0.1
    assert matplotlib.image.imread(tmp_path / "b.png").shape[2] == pytest.approx(4)


def test_a_short_seed_ends_without_cutting_the_others():
    curves = [Curve(np.array([0.0, 50.0, 100.0]), np.full(3, level)) for level in (2.0, 4.0)]
    grid, values = _on_one_grid([*curves, Curve(np.array([0.0, 5.0]), np.array([9.0, 9.0]))])
    assert grid[0] == 0.0 and grid[-1] == 100.0
    np.testing.assert_allclose(_mean(values)[[0, -1]], [5.0, 3.0])
    np.testing.assert_allclose(_mean(values)[grid > 5.0], 3.0)


def test_bands_are_the_intervals_of_the_tables():
    assert np.isnan(_band(np.array([1.0, 2.0]))).all()
    assert _band(np.array([1.0, 2.0, 4.0])) == student_interval([1.0, 2.0, 4.0])
