"""Learning curves with intervals, and the picture of a landscape."""

import matplotlib.image
import numpy as np
import pytest

from rewax.statistics import Curve
from rewax.viz.curves import curves_with_intervals, landscape_picture


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
