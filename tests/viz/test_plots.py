"""Pictures have the size and the ink they should, and draw shapes where they are."""

import matplotlib.image
import numpy as np
import pytest

from rewax.viz import plots


def capsule(center=(0.5, 0.2, 0.5), direction=(0.0, 0.0, 1.0)):
    return {"kind": "capsule", "center": center, "radius": 0.05, "half_length": 0.2, "direction": direction}


def metrics(num_rows):
    steps = np.arange(num_rows) * 100.0
    returns = np.where(np.arange(num_rows) % 3 == 0, np.nan, np.sin(steps))
    return {"env_steps": steps, "return": returns, "entropy": -steps, "alpha": np.exp(-steps)}


@pytest.mark.parametrize("num_rows", [0, 1, 50, 400])
def test_learning_curve(tmp_path, num_rows):
    evaluation = {"env_steps": np.array([0.0, 900.0])}
    for name in ("sampled", "deterministic"):
        evaluation |= {f"{name}_mean": np.array([0.0, 1.0]), f"{name}_std": np.array([0.1, np.nan])}
    path = plots.learning_curve(
        metrics(num_rows), tmp_path / "a.png", evaluation=evaluation, baselines={"no action": -1.0, "random": -2.0}
    )
    image = matplotlib.image.imread(path)
    assert image.shape[:2] == (810, 1050)
    assert 0.01 < np.mean(image[..., :3].min(axis=-1) < 0.9) < 0.5


def test_learning_curve_of_a_run_without_anything(tmp_path):
    assert plots.learning_curve({}, tmp_path / "a.png").stat().st_size > 2000


@pytest.mark.parametrize("num_frames", [1, 3, 6])
def test_particle_strip_has_a_column_for_each_frame(tmp_path, num_frames):
    cloud = np.random.default_rng(0).uniform([0.4, 0.0, 0.4], [0.6, 0.1, 0.6], (300, 3))
    path = plots.particle_strip(
        [cloud] * num_frames,
        tmp_path / "a.png",
        labels=[f"{i} s" for i in range(num_frames)],
        shapes=[[capsule()]] * num_frames,
    )
    image = matplotlib.image.imread(path)
    assert image.shape[1] > 150 * 3 * num_frames or num_frames == 6
    dark = image[..., :3].min(axis=-1) < 0.5  # viridis
    columns = np.array_split(dark[:, int(0.08 * dark.shape[1]) : int(0.88 * dark.shape[1])], num_frames, axis=1)
    inked = [float(column.mean()) for column in columns]
    assert min(inked) > 0.1 and max(inked) < 2.5 * min(inked)


def test_up_may_be_another_axis(tmp_path):
    """A picture of turned particles and shapes is the picture of the others, but for the axes' names."""
    cloud = np.random.default_rng(0).uniform([0.4, 0.0, 0.4], [0.6, 0.1, 0.6], (300, 3))
    cloud = cloud[(cloud[:, 0] < 0.45) | (cloud[:, 2] < 0.45)]  # an L, which no mirror leaves as it is
    to_z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # y becomes z
    turned = capsule(center=to_z @ (0.5, 0.2, 0.5), direction=to_z @ (0.0, 0.0, 1.0))
    pictures = [
        matplotlib.image.imread(plots.particle_strip([points], tmp_path / f"{i}.png", shapes=[[shape]], up=up))
        for i, (points, shape, up) in enumerate(
            [(cloud, capsule(), (0, 1, 0)), (cloud @ to_z.T, turned, (0, 0, 1)), (cloud @ to_z.T, turned, (0, 1, 0))]
        )
    ]
    assert pictures[0].shape == pictures[1].shape
    assert np.mean(np.abs(pictures[0] - pictures[1])) < 0.01
    assert np.mean(np.abs(pictures[0] - pictures[2])) > 0.05


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1)])
def test_both_views_are_seen_from_outside(tmp_path, monkeypatch, up):
    """Near is below far when seen from above; what is nearer to the eye hides what is behind it."""
    figures = []

    class Kept(plots.Figure):
        def __init__(self, **options):
            super().__init__(**options)
            figures.append(self)

    monkeypatch.setattr(plots, "Figure", Kept)
    axes = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]] if up == (0, 1, 0) else [[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    near_and_low, far_and_high = np.array([0.0, 0.0, 1.0]) @ axes, np.array([0.0, 0.1, 0.0]) @ axes
    rod = capsule(center=near_and_low, direction=np.array([1.0, 0.0, 0.0]) @ axes)
    clouds = [np.stack([near_and_low, far_and_high]), np.stack([far_and_high, near_and_low])]
    plots.particle_strip(clouds, tmp_path / "a.png", shapes=[[rod]] * 2, up=up, diameter=0.3)
    panels = figures[0].axes[:4]
    for i, panel in enumerate(panels):
        (particles,), (outline,) = panel.collections, panel.patches
        order = (
            [0.1, 0.0] if i < 2 else [0.0, 0.1]
        )  # heights: from the side the near one is last, from above the high one
        np.testing.assert_allclose(particles.get_array(), order)
        pixels = panel.transData.transform(particles.get_offsets())[:, 1]
        near, far = pixels[np.argsort(order)]
        assert near < far
        assert panel.transData.transform(outline.get_xy()[:-1])[:, 1].mean() == pytest.approx(near, abs=1.0)


def test_dollar_signs_are_no_mathematics(tmp_path):
    name = "cost_$\\bad$"
    assert plots.plain("a$b") == r"a\$b"
    cloud = np.random.default_rng(0).uniform(size=(20, 3))
    plots.particle_strip([cloud], tmp_path / "a.png", title=name, labels=[name])
    plots.learning_curve(metrics(3), tmp_path / "b.png", baselines={name: 1.0})


def test_bounds_hold_every_shape():
    low, high = plots._bounds([np.zeros((1, 3))], [[capsule(direction=(2.0, 0.0, 0.0))]])
    assert low[0] < 0.0 and high[0] > 0.75 and high[2] > 0.55


def test_a_ground_is_no_reason_to_zoom_out():
    ground = {"kind": "plane", "center": (9.0, 0.0, 0.0), "direction": (0.0, 1.0, 0.0)}
    low, high = plots._bounds([np.eye(3)], [[ground]])
    np.testing.assert_allclose([low, high], [[-0.04] * 3, [1.04] * 3], atol=1e-6)


def test_unknown_shapes_are_refused(tmp_path):
    with pytest.raises(ValueError, match="cannot draw a shape of kind 'torus': use one of 'sphere', 'ellipsoid'"):
        plots.particle_strip([np.eye(3)], tmp_path / "a.png", shapes=[[{**capsule(), "kind": "torus"}]])
