"""Pictures of rigid bodies show them, above their ground, wherever they went."""

import matplotlib.image
import numpy as np
import pytest

from rewax.viz.bodies import body_strip
from rewax.viz.meshes import mesh

SKY, SOIL, INK = (1.0, 1.0, 1.0), (0.93, 0.93, 0.93), (0.22, 0.42, 0.65)


def scene(x, height=0.5, up=1):
    """A ball of radius 0.2 at x over a ground."""
    normal = np.eye(3)[up]
    ball = {"kind": "sphere", "center": x * np.eye(3)[0] + height * normal, "radius": 0.2}
    return [{"kind": "plane", "center": np.zeros(3), "direction": 2.0 * normal}, ball]


def pixels(path, color):
    """Rows and columns of pixels of a colour."""
    image = matplotlib.image.imread(path)[..., :3]
    return np.nonzero(np.all(np.abs(image - color) < 0.02, axis=-1)), image.shape[:2]


@pytest.mark.parametrize("up", [1, 2])
def test_the_ball_is_round_and_above_the_ground_whatever_points_up(tmp_path, up):
    path = body_strip([scene(0.0, up=up)], tmp_path / "a.png", up=np.eye(3)[up])
    (rows, columns), _ = pixels(path, INK)
    soil_rows = np.flatnonzero(np.bincount(pixels(path, SOIL)[0][0]) > 50)  # texts have grey edges too
    assert rows.max() < soil_rows.min()  # row 0 is the top
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    assert height > 50 and abs(height - width) <= 2
    assert len(rows) == pytest.approx(np.pi / 4 * height * width, rel=0.03)
    gap = soil_rows.min() - rows.max()  # from the ball to the ground: 0.3 m, 3/4 of the ball's height
    assert gap / height == pytest.approx(0.75, abs=0.04)


def test_each_panel_follows_its_frame_and_labels_count(tmp_path):
    path = body_strip([scene(0.0), scene(70.0), scene(-3.0)], tmp_path / "a.png", labels=["0 s", "1 s", "2 s"])
    (_, columns), (_, width) = pixels(path, INK)
    panels = np.split(np.unique(columns), np.nonzero(np.diff(np.unique(columns)) > 3)[0] + 1)
    assert len(panels) == 3
    sizes = [len(panel) for panel in panels]
    assert max(sizes) - min(sizes) <= 2
    middles = np.array([panel.mean() for panel in panels])
    assert np.ptp(np.diff(middles)) <= 0.02 * width  # in the middle of panels of equal width


def test_what_is_nearer_to_the_eye_covers_what_is_behind(tmp_path):
    """z points to the eye; the ball behind is drawn lighter."""
    ball = {"kind": "sphere", "center": np.array([0.0, 0.5, 1.0]), "radius": 0.2}
    behind = {**ball, "center": np.array([0.1, 0.5, -1.0])}
    for shapes in ([ball, behind], [behind, ball]):
        near = pixels(body_strip([shapes], tmp_path / "a.png"), INK)[0]
        far = pixels(tmp_path / "a.png", (0.75, 0.82, 0.90))[0]
        assert np.ptp(near[1]) == pytest.approx(np.ptp(near[0]), abs=2)  # a whole disc
        assert len(far[0]) < 0.5 * len(near[0])


def test_a_ball_by_another_name_looks_the_same(tmp_path):
    ground, ball = scene(0.0)
    surface = mesh(ball)
    egg = {"kind": "ellipsoid", "center": ball["center"], "semi_axes": np.full(3, 0.2), "rotation": np.eye(3)}
    body = {"kind": "mesh", "center": ball["center"], "vertices": surface.vertices, "triangles": surface.triangles}
    images = [
        matplotlib.image.imread(body_strip([[ground, shape]], tmp_path / "a.png"))
        for shape in (ball, egg, {**body, "rotation": np.eye(3)})
    ]
    for image in images[1:]:
        assert image.shape == images[0].shape
        assert np.mean(np.abs(image - images[0]).max(axis=-1) > 0.1) < 0.01  # edges


def test_planes_that_face_the_eye_are_left_out(tmp_path):
    wall = {"kind": "plane", "center": np.zeros(3), "direction": np.array([0.0, 0.0, 1.0])}
    path = body_strip([[wall, scene(0.0)[1]]], tmp_path / "a.png")
    assert len(pixels(path, SOIL)[0][0]) < 1000 and len(pixels(path, INK)[0][0]) > 2000


def test_frames_without_anything_to_follow_are_refused(tmp_path):
    with pytest.raises(ValueError, match="nothing to follow"):
        body_strip([scene(0.0)[:1]], tmp_path / "a.png")
    with pytest.raises(ValueError, match="cannot draw a shape of kind 'torus'"):
        body_strip([[{**scene(0.0)[1], "kind": "torus"}]], tmp_path / "a.png")
