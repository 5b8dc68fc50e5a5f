"""Pictures of an episode: of particles, or of bodies alone with their own vertical, up to the episode's end."""

import types

import matplotlib.image
import numpy as np
import pytest

from rewax.training.evaluate import Frame
from rewax.training.report import _draw_episode
from rewax.viz import bodies, plots


def shapes(height):
    ball = {"kind": "sphere", "center": np.array([0.0, 0.0, height]), "radius": 0.2}
    return [{"kind": "plane", "center": np.zeros(3), "direction": np.array([0.0, 0.0, 1.0])}, ball]


def frames(*steps):
    return [Frame(step, np.float32(0.5), 0.1 * step) for step in steps]


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
    env = types.SimpleNamespace(render_shapes=shapes, up=np.array([0.0, 0.0, 1.0]))
    path = _draw_episode(env, frames(0, 10, 20), tmp_path / "episode.png")
    assert list(drawn) == ["body_strip"]
    assert drawn["body_strip"]["labels"] == ["step 0\nreturn 0", "step 10\nreturn 1", "step 20\nreturn 2"]
    np.testing.assert_array_equal(drawn["body_strip"]["up"], [0.0, 0.0, 1.0])
    assert matplotlib.image.imread(path).shape[1] > 900


def test_nothing_is_drawn_after_the_end(tmp_path, drawn):
    env = types.SimpleNamespace(render_shapes=shapes, up=np.array([0.0, 0.0, 1.0]))
    _draw_episode(env, frames(0, 10, 14, 14, 14), tmp_path / "episode.png")
    assert drawn["body_strip"]["count"] == 3 and drawn["body_strip"]["labels"][-1] == "step 14\nreturn 1.4"


def test_particles_among_bodies(tmp_path, drawn):
    cloud = np.random.default_rng(0).uniform(size=(50, 3))
    env = types.SimpleNamespace(render_shapes=shapes, particles=lambda physics: cloud + physics)
    _draw_episode(env, frames(0, 10), tmp_path / "episode.png")
    assert list(drawn) == ["particle_strip"]
    assert [len(frame) for frame in drawn["particle_strip"]["shapes"]] == [2, 2]
    env = types.SimpleNamespace(particles=lambda physics: cloud + physics)
    _draw_episode(env, frames(0, 10), tmp_path / "episode.png")
    assert drawn["particle_strip"]["shapes"] == [[], []]
