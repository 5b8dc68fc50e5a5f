"""Videos hold the frames they were given, at the rate they were given."""

import imageio_ffmpeg
import numpy as np
import pytest
import recordings

from rewax.viz import video


def read(path):
    """Frames per second and frames of a video."""
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    return meta["fps"], [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


def test_frames_and_rate_come_back(tmp_path):
    grey = [np.full((32, 48, 3), 20 * i, np.uint8) for i in range(10)]
    path = video.write_video(iter(grey), tmp_path / "a.mp4", rate=12.5, size=(32, 48))
    rate, frames = read(path)
    assert rate == pytest.approx(12.5, abs=0.01) and len(frames) == 10
    for i, frame in enumerate(frames):
        assert abs(frame.mean() - 20 * i) < 6
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]


def test_a_recording_plays_as_long_as_it_lasted(tmp_path):
    said = video.record_video(
        recordings.cloud(31, control_dt=0.1), tmp_path / "a.mp4", size=(64, 96), renderer="software"
    )
    rate, frames = read(tmp_path / "a.mp4")
    assert said == "in real time" and (len(frames) - 1) / rate == pytest.approx(3.0, rel=0.02)
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 1.0


def test_a_folder_may_have_a_colon(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = video.write_video([np.zeros((32, 48, 3), np.uint8)] * 3, "run:1/a.mp4", rate=10.0, size=(32, 48))
    assert len(read(tmp_path / path)[1]) == 3


def test_what_cannot_be_is_refused_and_a_failure_leaves_no_file(tmp_path, monkeypatch):
    for size, rate, said in (
        ((31, 48), 10.0, "size is 31 x 48: H.264 needs even numbers"),
        ((32, 48), 0.0, "rate is 0.0"),
    ):
        with pytest.raises(ValueError, match=said):
            video.write_video([], tmp_path / "a.mp4", rate=rate, size=size)

    def broken():
        yield np.zeros((32, 48, 3), np.uint8)
        raise RuntimeError("the picture failed")

    with pytest.raises(RuntimeError, match="the picture failed"):
        video.write_video(broken(), tmp_path / "a.mp4", rate=10.0, size=(32, 48))
    assert not list(tmp_path.iterdir())
    failing = tmp_path / "ffmpeg"
    failing.write_text(
        "#!/bin/sh\nfor last; do :; done\necho part > $last\necho 'No space left on device' >&2\nexit 1\n"
    )
    failing.chmod(0o755)
    monkeypatch.setattr(video, "_ffmpeg", lambda: str(failing))
    with pytest.raises(OSError, match=r"ffmpeg failed; it said: .*No space left on device"):
        video.write_video([np.zeros((32, 48, 3), np.uint8)], tmp_path / "a.mp4", rate=10.0, size=(32, 48))
    assert list(tmp_path.iterdir()) == [failing]  # not the part either
