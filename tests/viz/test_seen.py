"""Pictures of cameras: colours of bytes, the pane beside a video, the page's data."""

import imageio_ffmpeg
import numpy as np
import pytest
import recordings

from rewax.viz import video
from rewax.viz.beside import beside, pane_width
from rewax.viz.colors import SCALE
from rewax.viz.seen import BACKGROUND, LABELS, LARGEST_SIDE, NOTHING, Seen, stride


def seen_of(num_frames=5, kind="depth"):
    """A picture of 16 x 24 pixels whose left half moves away and whose right half sees nothing."""
    pixels = np.full((num_frames, 16, 24), NOTHING, np.uint8)
    pixels[:, :, :12] = (0 if kind == "depth" else 1) + 40 * np.arange(num_frames)[:, None, None] * (kind == "depth")
    names = {"names": ("tool", "dough")} if kind == "bodies" else {"near": 0.5, "far": 2.0}
    return Seen(name="depth", kind=kind, pixels=pixels, **names)


def seeing(num_frames=5, kinds=("depth", "bodies"), **options):
    return recordings.moving_ball(num_frames, seen=[seen_of(num_frames, kind) for kind in kinds], **options)


def test_bytes_have_the_colours_of_their_depth_or_body():
    depth, bodies = seen_of(), seen_of(kind="bodies")
    colors = depth.colors()
    np.testing.assert_allclose(colors[[0, NOTHING - 1, NOTHING]], [SCALE[0], SCALE[-1], BACKGROUND])
    np.testing.assert_allclose(bodies.colors()[[0, 1, 10, NOTHING]], [LABELS[0], LABELS[1], LABELS[0], BACKGROUND])
    picture = bodies.picture(3)
    assert picture.shape == (16, 24, 3) and picture.dtype == np.uint8
    np.testing.assert_array_equal(picture[0, 0], np.round(255 * LABELS[1]))
    assert (depth.title, bodies.title) == ("depth [m]", "depth: bodies")


def test_frames_are_taken_with_those_of_the_recording():
    recording = seeing(6)
    taken = recording.take([1, 5])
    np.testing.assert_array_equal(taken.seen[0].pixels, recording.seen[0].pixels[[1, 5]])
    assert taken.seen[1].names == ("tool", "dough")
    with pytest.raises(ValueError, match=r"depth \[m\] has 4 frames, not 5: give one for each"):
        recordings.moving_ball(5, seen=[seen_of(4)])


@pytest.mark.parametrize("pixels", [np.zeros((1, 4, 4)), np.zeros((4, 4), np.uint8), np.zeros((1, 4, 200), np.uint8)])
def test_pixels_that_are_too_many_or_no_bytes_are_refused(pixels):
    with pytest.raises(ValueError, match=r"pixels of depth are .*: give uint8 of shape .* at most 128 pixels a side"):
        Seen(name="depth", kind="depth", pixels=pixels)


def test_large_pictures_are_thinned_until_they_fit():
    for height, width in ((64, 64), (128, 128), (129, 4), (480, 640)):
        every = stride(height, width)
        assert -(-max(height, width) // every) <= LARGEST_SIDE and (every == 1 or max(height, width) / every > 64)


def test_the_pane_shows_each_frame_beside_the_scene():
    recording = seeing()
    frames = [np.full((120, 160, 3), 7 * i, np.uint8) for i in range(5)]
    width = pane_width(recording, 120)
    shown = list(beside(recording, iter(frames), 120))
    assert width % 2 == 0 and all(frame.shape == (120, 160 + width, 3) for frame in shown)
    for i, frame in enumerate(shown):
        np.testing.assert_array_equal(frame[:, :160], frames[i])
        np.testing.assert_array_equal(frame[22, 170], recording.seen[0].picture(i)[0, 0])  # the picture's corner
        np.testing.assert_array_equal(frame[82, 170], np.round(255 * LABELS[1]))
    plain = recordings.moving_ball()
    assert pane_width(plain, 120) == 0 and next(iter(beside(plain, iter(frames), 120))) is frames[0]


def test_more_pictures_than_fit_below_each_other_stand_in_several_panes():
    recording = seeing(kinds=("depth", "bodies") * 2)
    frame = np.zeros((120, 160, 3), np.uint8)
    (shown,) = beside(recording.take([2]), [frame], 120)
    two = pane_width(seeing(), 120)
    assert pane_width(recording, 120) == 2 * two and shown.shape == (120, 160 + 2 * two, 3)
    np.testing.assert_array_equal(shown[:, 160 : 160 + two], shown[:, 160 + two :])
    for kinds in (3, 7):
        assert pane_width(seeing(kinds=("depth",) * kinds), 120) > 0


def test_a_video_of_a_seeing_recording_is_wider_and_plays(tmp_path):
    recording = seeing(kinds=("depth",))
    video.record_video(recording, tmp_path / "a.mp4", size=(96, 128), renderer="software")
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    assert tuple(next(reader)["size"]) == (128 + pane_width(recording, 96), 96)
