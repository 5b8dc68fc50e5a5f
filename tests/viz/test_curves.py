"""Learning curves of seeds, and the picture of a landscape."""

import matplotlib.image
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from rewax.statistics import Curve
from rewax.viz.curves import CURVE_COLORS, curves_of_seeds, landscape_picture, mean_curve


def curve(offset, n=40):
    steps = np.arange(1.0, n + 1) * 10
    return Curve(steps, offset + np.log(steps))


def test_curves_are_drawn_for_any_number_of_seeds(tmp_path):
    nothing = Curve(np.zeros(0), np.zeros(0))
    runs = {"sapo": [curve(0.0), curve(1.0), curve(2.0, 30)], "shac": [curve(3.0), nothing], "never": []}
    path = curves_of_seeds(runs, tmp_path / "a.png", title="Task", levels={"no action": 2.0})
    assert matplotlib.image.imread(path).std() > 0.05


@pytest.mark.parametrize("num_names", [3, 10, 40])
def test_a_long_legend_hides_no_curves(monkeypatch, num_names):
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda self, _: drawn.append(self))
    curves_of_seeds({f"algorithm {i}": [Curve(np.arange(9.0), np.arange(9.0) + i)] for i in range(num_names)}, "x.png")
    (figure,), axes = drawn, drawn[0].axes[0]
    figure.draw_without_rendering()
    (legend,) = figure.legends or [axes.get_legend()]
    extent, whole = legend.get_window_extent(), figure.bbox
    assert whole.y0 <= extent.y0 and extent.y1 <= whole.y1
    assert (extent.x0 >= axes.get_window_extent().x1) == (num_names > 3)
    assert axes.get_window_extent().width > 0.6 * whole.width


@pytest.mark.parametrize(("num_low", "tall"), [(1, True), (10, False)])
def test_a_few_very_low_points_do_not_flatten_the_curves(tmp_path, num_low, tall):
    returns = np.where(np.arange(100) < num_low, -200.0, np.linspace(0.0, 1.0, 100))
    picture = matplotlib.image.imread(
        curves_of_seeds({"sac": [Curve(np.arange(100.0), returns)]}, tmp_path / "a.png", levels={"no action": -1.0})
    )
    right = picture[:, picture.shape[1] // 3 :, :3]
    num_rows = (np.abs(right - to_rgb(CURVE_COLORS[0])).max(axis=2) < 0.02).any(axis=1).sum()
    assert (num_rows > 100) == tall


def test_the_landscape_is_drawn(tmp_path):
    offsets = np.linspace(-1.0, 1.0, 5)
    hill = -(offsets[:, None] ** 2) - 2.0 * offsets**2
    hill[0, 0] = np.nan  # a policy may fail somewhere
    picture = matplotlib.image.imread(landscape_picture(offsets, hill, tmp_path / "b.png"))
    assert picture.std() > 0.1
    assert matplotlib.image.imread(tmp_path / "b.png").shape[2] == pytest.approx(4)


@pytest.mark.parametrize("kind", ["equal", "nearly equal", "all missing", "one known", "infinite"])
def test_a_landscape_without_hills_is_drawn(tmp_path, kind):
    returns = np.full((5, 5), -1950.0, np.float32)
    if kind == "nearly equal":
        returns[2, 2] = np.nextafter(returns[2, 2], np.float32(0.0))
    elif kind == "infinite":
        returns = np.arange(25.0, dtype=np.float32).reshape(5, 5)
        returns[0, 0], returns[4, 4] = -np.inf, np.inf
    elif kind != "equal":
        returns[:] = np.nan
        returns[2, 2] = np.nan if kind == "all missing" else 1.0
    picture = landscape_picture(np.linspace(-1.0, 1.0, 5), returns, tmp_path / "a.png", title="$\\none$")
    assert matplotlib.image.imread(picture)[..., :3].std() > 0.05


def test_a_short_seed_ends_without_cutting_the_others():
    curves = [Curve(np.array([0.0, 50.0, 100.0]), np.full(3, level)) for level in (2.0, 4.0)]
    grid, mean = mean_curve([*curves, Curve(np.array([0.0, 5.0]), np.array([9.0, 9.0]))])
    assert grid[0] == 0.0 and grid[-1] == 100.0
    np.testing.assert_allclose(mean[[0, -1]], [5.0, 3.0])
    np.testing.assert_allclose(mean[grid > 7.0], 3.0)
    apart = mean_curve([curves[0], Curve(np.array([200.0, 300.0]), np.ones(2))]).returns
    assert np.isnan(apart[40]) and apart[0] == 2.0 and apart[-1] == 1.0
    one = mean_curve([Curve(np.array([7.0]), np.array([3.0]))])
    assert (one.returns == 3.0).all()
