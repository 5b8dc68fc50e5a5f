"""Pictures one by one: the camera stands still, moves where it must, and goes with what travels far."""

import numpy as np
import recordings

from rewax.viz.camera import frame_recording
from rewax.viz.steady import SteadyPictures

SIZE = (48, 64)


def framings(recording):
    """The camera of each frame, as if it were drawn while the episode goes on."""
    pictures = SteadyPictures(SIZE)
    return [pictures.frame(recording.take([i])) for i in range(recording.num_frames)]


def moves(found):
    """How often the camera comes nearer or goes away."""
    return int((np.diff([framing.distance for framing in found]) != 0.0).sum())


def test_a_small_motion_leaves_the_camera_where_it_is():
    recording = recordings.cloud(4, travel=0.01, num_particles=200)
    first, *others = framings(recording)
    assert all(framing is first for framing in others)
    pictures = SteadyPictures(SIZE)
    drawn = [pictures.draw(recording.take([i])).astype(int) for i in range(4)]
    assert drawn[0].shape == (*SIZE, 3) and (drawn[0] != drawn[3]).any()
    np.testing.assert_array_equal(drawn[0][-1], drawn[3][-1])  # the floor in front


def test_the_camera_goes_away_only_where_it_must_and_never_comes_back():
    recording = recordings.moving_ball(60, travel=0.02, camera={"follow": False})
    found = framings(recording)
    distances = np.array([framing.distance for framing in found])
    assert np.all(np.diff(distances) >= 0.0) and 1 <= moves(found) <= 6
    for i in range(60):
        for j in range(i):  # all that the episode has shown
            center = recording.drawings[j][1]["center"]
            column, row, _ = found[i].camera(0, recording.up).project(center, *SIZE)
            assert 0.0 < column < SIZE[1] and 0.0 < row < SIZE[0]


def test_the_camera_follows_what_travels_far_from_one_distance():
    recording = recordings.moving_ball(60, travel=0.1)
    found = framings(recording)
    assert moves(found) <= 6 and moves(found[20:]) == 0 and found[-1].follow
    np.testing.assert_allclose(found[-1].targets, [recording.drawings[-1][1]["center"]], atol=1e-6)
    alone = frame_recording(recording.take([59])).distance
    assert alone < found[-1].distance < 2.0 * alone


def test_a_near_camera_stands_still_too():
    """A zoom cuts off what the camera would otherwise show; that is no reason to move."""
    found = framings(recordings.moving_ball(5, travel=0.01, camera={"zoom": 4.0}))
    assert moves(found) == 0
