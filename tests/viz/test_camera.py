"""Cameras show everything that happens, right side up."""

import numpy as np
import pytest
import recordings

from rewax.viz.camera import frame_recording, look
from rewax.viz.player import write_player
from rewax.viz.render import pictures


@pytest.mark.parametrize("up", [np.eye(3)[1], np.eye(3)[2]])
def test_directions_are_a_right_handed_frame_and_up_is_up(up):
    camera = look(np.ones(3), up=up, azimuth=35.0, elevation=20.0, distance=4.0)
    axes = np.stack([camera.right, camera.up, -camera.forward])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(camera.eye + 4.0 * camera.forward, np.ones(3))
    column, row, depth = camera.project(np.ones(3) + 0.1 * up, 200, 300)
    assert column == pytest.approx(150.0) and row < 100.0 and 3.5 < depth < 4.0
    assert camera.right @ up == pytest.approx(0.0)


@pytest.mark.parametrize("options", [{}, {"azimuth": 120.0, "elevation": 60.0}])
def test_everything_is_within_the_picture_and_fills_much_of_it(options):
    recording = recordings.cloud(travel=0.05, camera=options)
    framing = frame_recording(recording)
    places = np.stack(
        [np.stack(framing.camera(i, recording.up).project(p, 300, 400)[:2]) for i, p in enumerate(recording.particles)]
    )
    assert places.min() > 0.0 and places[:, 0].max() < 400.0 and places[:, 1].max() < 300.0
    extent = np.ptp(places, axis=(0, 2)) / [400.0, 300.0]
    assert extent.max() > 0.45
    assert not framing.follow and framing.floor == 0.0


def test_the_camera_goes_with_what_travels_far():
    framing = frame_recording(recordings.moving_ball(50, travel=0.5))
    assert framing.follow
    steps = np.diff(framing.targets[10:-10, 0])
    np.testing.assert_allclose(steps, 0.5, rtol=1e-6)
    still = frame_recording(recordings.moving_ball(50, travel=0.5, camera={"follow": False}))
    assert not still.follow and still.distance > 3.0 * framing.distance


def test_the_camera_is_at_what_two_frames_show():
    framing = frame_recording(recordings.moving_ball(2, travel=30.0))
    assert framing.follow
    np.testing.assert_allclose(framing.targets, [[0.0, 0.5, 0.0], [30.0, 0.5, 0.0]])
    assert framing.distance == pytest.approx(frame_recording(recordings.moving_ball(1)).distance)


def test_the_floor_is_the_plane_or_just_below_everything():
    assert frame_recording(recordings.moving_ball()).floor == 0.0
    alone = recordings.made(1, drawings=[[recordings.BALL]])
    assert frame_recording(alone).floor == pytest.approx(0.3)
    assert frame_recording(recordings.moving_ball(floor=-1.0)).floor == -1.0


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        ({"azimut": 3.0}, "camera has an unknown key 'azimut': use azimuth, elevation, zoom, follow"),
        ({"zoom": 0}, "camera has zoom 0: give a number above 0"),
        ({"zoom": -1.0}, "camera has zoom -1.0: give a number above 0"),
        ({"zoom": np.inf}, "camera has zoom inf: give a finite number"),
        ({"azimuth": np.nan}, "camera has azimuth nan: give a finite number"),
        ({"elevation": "high"}, "camera has elevation 'high': give a finite number"),
    ],
)
def test_what_no_camera_can_be_is_refused(camera, said):
    with pytest.raises(ValueError, match=said):
        frame_recording(recordings.moving_ball(camera=camera))


def test_a_point_can_be_shown(tmp_path):
    point = recordings.made(1, drawings=[[{**recordings.BALL, "radius": 0.0}]])
    assert frame_recording(point).radius > 0.0
    write_player([point], tmp_path / "a.html")
    assert next(pictures(point, size=(30, 40), renderer="software")).shape == (30, 40, 3)
