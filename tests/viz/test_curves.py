"""Learning curves with intervals, and the picture of a landscape."""

import matplotlib.image
import numpy as np
import pytest

from rewax.viz.curves import curves_with_intervals, landscape_picture, smoothed


def columns(offset, n=40):
    steps = np.arange(1.0, n + 1) * 10
    returns = offset + np.log(steps)
    returns[::3] = np.nan
    return {"env_steps": steps, "return": returns}


def test_smoothing_weighs_the_past_and_leaves_out_what_is_unknown():
    steps, means = smoothed({"env_steps": np.arange(4.0), "return": np.array([1.0, np.nan, 3.0, 5.0])}, decay=0.5)
    np.testing.assert_array_equal(steps, [0.0, 2.0, 3.0])
    np.testing.assert_allclose(means, [1.0, (0.5 + 3.0) / 1.5, (0.25 + 1.5 + 5.0) / 1.75])
    assert smoothed({"env_steps": np.arange(2.0), "return": np.full(2, np.nan)}) is None


def test_curves_are_drawn_for_any_number_of_seeds(tmp_path):
    runs = {"sapo": [columns(0.0), columns(1.0), columns(2.0, 30)], "shac": [columns(3.0)], "never": []}
    path = curves_with_intervals(runs, tmp_path / "a.png", title="Task", levels={"no action": 2.0})
    assert matplotlib.image.imread(path).std() > 0.05


def test_the_landscape_is_drawn(tmp_path):
    offsets = np.linspace(-1.0, 1.0, 5)
    hill = -(offsets[:, None] ** 2) - 2.0 * offsets**2
    picture = matplotlib.image.imread(landscape_picture(offsets, hill, tmp_path / "b.png"))
    assert picture.std() > 0.1
    assert matplotlib.image.imread(tmp_path / "b.png").shape[2] == pytest.approx(4)
