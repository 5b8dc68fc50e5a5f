"""Pictures of an episode: of particles, or of bodies alone with their own vertical; none of them ends a run."""

import matplotlib.image
import numpy as np
import pytest
import recordings

from rewax.training.evaluation.pictures import attempt, draw_page, draw_strip, draw_video
from rewax.viz import bodies, plots, video


@pytest.fixture
def drawn(monkeypatch):
    """What was drawn, by which function."""
    calls = {}

    def spy(module, name):
        original = getattr(module, name)

        def call(pictures, out_png, **kwargs):
            calls[name] = {"count": len(pictures), **kwargs}
            return original(pictures, out_png, **kwargs)

        monkeypatch.setattr(module, name, call)

    spy(bodies, "body_strip")
    spy(plots, "particle_strip")
    return calls


def test_bodies_with_their_own_vertical(tmp_path, drawn):
    path, recording = tmp_path / "episode.png", recordings.moving_ball(21, rewards=np.full(20, 0.1))
    assert attempt(path, lambda path: draw_strip(recording, path, num_frames=3)) == f"wrote {path}"
    assert list(drawn) == ["body_strip"]
    assert drawn["body_strip"]["labels"] == ["step 0\nreturn 0", "step 10\nreturn 1", "step 20\nreturn 2"]
    np.testing.assert_array_equal(drawn["body_strip"]["up"], [0.0, 1.0, 0.0])
    assert matplotlib.image.imread(path).shape[1] > 300


def test_particles_among_bodies(tmp_path, drawn):
    draw_strip(recordings.cloud(2, drawings=[[recordings.BALL]] * 2), tmp_path / "episode.png", num_frames=6)
    assert list(drawn) == ["particle_strip"] and drawn["particle_strip"]["count"] == 2
    assert [len(frame) for frame in drawn["particle_strip"]["shapes"]] == [1, 1]
    draw_strip(recordings.cloud(2), tmp_path / "episode.png", num_frames=6)
    assert [len(frame) for frame in drawn["particle_strip"]["shapes"]] == [0, 0]


def test_a_video_says_how_fast_it_plays_and_a_page_is_written(tmp_path):
    recording = recordings.cloud(5, num_particles=5)
    mp4, page = tmp_path / "episode.mp4", tmp_path / "episode.html"
    said = attempt(mp4, lambda path: draw_video(recording, path))
    assert said == f"wrote {mp4}, 5 times slower than real time" and mp4.stat().st_size > 1000
    assert attempt(page, lambda path: draw_page(recording, path)) == f"wrote {page}"
    assert "<title>by hand</title>" in page.read_text()


def test_a_failure_is_a_sentence_and_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "_ffmpeg", lambda: "/no/such/program")
    said = attempt(tmp_path / "episode.mp4", lambda path: draw_video(recordings.cloud(2), path))
    assert said.startswith("warning: episode.mp4 was not drawn (FileNotFoundError: ")
    assert said.endswith("; nothing else is affected") and "\n" not in said
    assert not list(tmp_path.iterdir())
