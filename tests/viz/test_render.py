"""The renderer that is asked for draws; one that fails is replaced; MuJoCo and numpy draw the same things."""

import itertools

import numpy as np
import pytest
import recordings

from rewax.viz import opengl
from rewax.viz.render import pictures

SIZE = (96, 128)


@pytest.fixture
def no_opengl(monkeypatch):
    monkeypatch.setattr(opengl, "find_opengl", lambda: None)


def drawn(recording, **options):
    return list(pictures(recording, size=SIZE, **options))


def test_without_opengl_every_frame_is_drawn_all_the_same(no_opengl):
    frames = drawn(recordings.cloud(11, travel=0.1))
    assert len(frames) == 11 and all(frame.shape == (*SIZE, 3) and frame.dtype == np.uint8 for frame in frames)
    steps = [np.abs(a.astype(int) - b).mean() for a, b in itertools.pairwise(frames)]
    assert min(steps) > 0.1  # they are in order, and each one is another
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > max(steps)


def test_a_driver_that_crashes_is_replaced_in_the_middle(monkeypatch):
    recording = recordings.cloud(4, travel=0.3, camera={"follow": False})  # later frames alone would be larger
    expected = drawn(recording, renderer="software", color_by="speed", surface=False)
    monkeypatch.setattr(opengl, "find_opengl", lambda: opengl.OpenGL("egl", "A graphics card"))

    def crash(recording, size, color_by, backend):
        yield expected[0]
        raise OSError("the process that draws with OpenGL ended early; it said: Segmentation fault")

    monkeypatch.setattr(opengl, "mujoco_pictures", crash)
    found = drawn(recording, color_by="speed", surface=False)
    np.testing.assert_array_equal(found, expected)


def test_what_cannot_be_is_refused_in_a_sentence(no_opengl):
    with pytest.raises(ValueError, match="renderer is 'blender': use one of auto, mujoco, software"):
        drawn(recordings.cloud(1), renderer="blender")
    with pytest.raises(ValueError, match="no OpenGL was found, neither EGL nor OSMesa: install one"):
        drawn(recordings.cloud(1), renderer="mujoco")
    with pytest.raises(ValueError, match="cannot be coloured by 'mass': use one of material, height, speed"):
        drawn(recordings.cloud(1), color_by="mass")


def test_a_process_that_ends_early_says_why():
    failing = recordings.cloud(1)
    object.__setattr__(failing, "camera", {"nonsense": 1})
    with pytest.raises(OSError, match="ended early; it said: "):
        next(opengl.mujoco_pictures(failing, SIZE, "material", "none_such"))


def test_probing_never_raises_and_the_variable_switches_it_off(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    assert opengl.find_opengl.__wrapped__() is None
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(opengl, "_command", lambda what: ["/no/such/program"])
    assert opengl.find_opengl.__wrapped__() is None


def test_mujoco_and_numpy_show_the_same():
    found = opengl.find_opengl()
    if found is None:
        pytest.skip("no OpenGL without a screen: neither EGL nor OSMesa draws here")
    capsule = {
        "kind": "capsule", "center": np.array([0.0, 0.4, 0.0]), "radius": 0.1, "half_length": 0.3,
        "direction": np.array([1.0, 0.0, 0.0]), "color": (0.9, 0.1, 0.1),
    }  # fmt: skip
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    egg = {**capsule, "kind": "ellipsoid", "semi_axes": np.array([0.4, 0.1, 0.2]), "rotation": turn}
    cone = {**capsule, "kind": "cone", "radius": 0.2, "direction": np.array([0.3, 1.0, 0.2])}
    corner = {**capsule, "kind": "mesh", "vertices": 0.7 * np.eye(4, 3), "rotation": turn}
    corner["triangles"] = np.array([(0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)])
    leaf = {**corner, "triangles": corner["triangles"][:1]}  # not closed
    for recording in (
        *(recordings.made(1, drawings=[[shape]], floor=0.0) for shape in (capsule, egg, cone, corner, leaf)),
        recordings.cloud(1, values={}, materials=np.zeros(60, int), material_names=("muscle",)),
    ):
        ours, theirs = (
            drawn(recording, renderer="software", surface=False)[0],
            next(opengl.mujoco_pictures(recording, SIZE, "material", found.name)),
        )
        red = [image[..., 0] > 1.5 * image[..., 2].astype(float) for image in (ours, theirs)]
        assert red[0].sum() > 100
        overlap = (red[0] & red[1]).sum() / (red[0] | red[1]).sum()
        assert overlap > 0.85
    speck = {**cone, "radius": 0.0}  # has no area: neither draws it, nor minds
    without, with_ = (
        next(opengl.mujoco_pictures(recordings.made(1, drawings=[shapes]), SIZE, "material", found.name))
        for shapes in (
            [recordings.BALL],
            [recordings.BALL, {**speck, "center": recordings.BALL["center"], "half_length": 0.1}],
        )
    )
    np.testing.assert_array_equal(without, with_)
