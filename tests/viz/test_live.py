"""The live page: served, moving, and another episode while it stays open."""

import socket
import sys
import time
import types
import urllib.request

import numpy as np
import pytest
import recordings

from rewax.viz import surface
from rewax.viz.camera import frame_recording
from rewax.viz.live import LiveViewer
from rewax.viz.live_matter import ROOT, ball


@pytest.fixture
def viewer():
    pytest.importorskip("viser")
    found = LiveViewer(port=0)
    yield found
    found.close()


@pytest.mark.parametrize(
    ("host", "sentence"), [("127.0.0.1", "choose another port"), ("192.0.2.1", "choose another host")]
)
def test_an_address_that_cannot_be_served(host, sentence):
    pytest.importorskip("viser")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(ValueError, match=sentence):
            LiveViewer(host=host, port=other.getsockname()[1])


def as_balls(viewer):
    viewer._surface.value = False
    viewer._rebuild()


def test_the_page_is_served_and_the_timeline_moves_particles(viewer):
    with urllib.request.urlopen(viewer.url, timeout=10) as page:
        assert page.status == 200 and b"<html" in page.read().lower()
    recording = recordings.cloud(5, travel=0.1)
    as_balls(viewer)
    viewer.show(recording, "**iteration 1**")
    viewer._playing.value = False
    assert [viewer.seek(part) for part in (0.0, 0.5, 1.0)] == [0, 2, 4]
    np.testing.assert_allclose(viewer.positions(), recording.particles[4], atol=1e-6)
    viewer.seek(0.0)
    np.testing.assert_allclose(viewer.positions(), recording.particles[0], atol=1e-6)


@pytest.mark.parametrize("num_frames", [2, 5])
def test_it_plays_by_itself_and_begins_again(viewer, num_frames):
    viewer.show(recordings.cloud(num_frames, travel=0.1))
    seen, deadline = [viewer._shown], time.monotonic() + 20.0
    while seen.count(0) < 2 and time.monotonic() < deadline:
        if viewer._shown != seen[-1]:
            seen.append(viewer._shown)
        time.sleep(0.01)
    assert set(seen) == set(range(num_frames)) and seen[-1] == 0


def test_the_last_frame_stays_for_a_while_on_a_slow_page_too(viewer):
    recording = recordings.moving_ball(5)
    viewer.show(recording)
    viewer._playing.value = False
    shown = []
    for seconds in (100.0, 0.4, 0.2, 0.2):
        viewer._advance(recording, seconds)
        shown.append(viewer._shown)
    assert shown == [4, 4, 0, 2]


def test_the_next_episode_replaces_the_last_one(viewer):
    viewer.show(recordings.cloud(5))
    viewer.show(recordings.moving_ball(3, travel=0.5))
    viewer._playing.value = False
    assert viewer.positions().shape == (0, 3)
    viewer.seek(1.0)
    ((_, ball),) = viewer._solids
    assert ball.position[0] == pytest.approx(1.0)
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    moved = np.stack([corners, corners + 1.0]).astype(np.float32)
    viewer.show(recordings.made(2, particles=moved, triangles=np.array([[0, 2, 1], [0, 1, 3]])))
    viewer.seek(1.0)
    np.testing.assert_allclose(viewer.positions(), moved[1])


def test_a_marker_that_changes_its_colour_is_shown_in_the_colour_of_the_frame(viewer):
    marker = {"kind": "sphere", "center": np.zeros(3), "radius": 0.1}
    viewer.show(recordings.made(2, drawings=[[marker], [{**marker, "color": (0.0, 1.0, 0.0)}]]))
    viewer._playing.value = False
    for time_shown, expected in ((0.0, [True, False]), (1.0, [False, True])):
        viewer.seek(time_shown)
        assert [handle.visible for _, handle in viewer._solids] == expected


def test_ellipsoids_cones_and_meshes_are_solids_with_the_poses_of_the_frame(viewer):
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about z

    def shapes(x, turn):
        egg = {
            "kind": "ellipsoid",
            "center": np.array([x, 0.5, 0.0]),
            "semi_axes": np.array([0.1, 0.2, 0.3]),
            "rotation": turn,
        }
        cone = {
            "kind": "cone",
            "center": np.array([x, 1.0, 0.0]),
            "radius": 0.1,
            "half_length": 0.2,
            "direction": turn[:, 1],
        }
        body = {"kind": "mesh", "vertices": np.eye(4, 3), "triangles": np.array([[0, 1, 2]])}
        return [egg, cone, {**body, "center": np.array([x, 2.0, 0.0]), "rotation": turn}]

    viewer.show(recordings.made(2, drawings=[shapes(0.0, np.eye(3)), shapes(1.0, quarter)], floor=0.0))
    viewer._playing.value = False
    viewer.seek(1.0)
    egg, cone, body = (handle for _, handle in viewer._solids)
    np.testing.assert_allclose([egg.position, cone.position, body.position], [[1, 0.5, 0], [1, 1, 0], [1, 2, 0]])
    for handle in (egg, cone, body):
        np.testing.assert_allclose(np.abs(np.dot(handle.wxyz, np.sqrt([0.5, 0.0, 0.0, 0.5]))), 1.0, atol=1e-6)
    np.testing.assert_allclose(egg.vertices.max(axis=0), [0.1, 0.2, 0.3], atol=0.01)
    np.testing.assert_allclose(cone.vertices[np.argmax(cone.vertices[:, 1])], [0.0, 0.2, 0.0], atol=1e-6)
    assert len(body.vertices) == 3 and len(body.faces) == 1


def test_colours_are_those_of_the_recording(viewer):
    as_balls(viewer)
    viewer.show(recordings.cloud(5))
    viewer._playing.value = False
    viewer.seek(0.0)
    before = np.asarray(viewer._matter._handle.batched_colors).copy()
    viewer._by.value = "speed"
    viewer._recolor()
    assert "speed" in viewer._by.options and not np.array_equal(before, viewer._matter._handle.batched_colors)


def test_the_page_follows_a_robot_that_runs_over_a_floor_that_does_not_end(viewer):
    recording = recordings.moving_ball(60, travel=0.5)
    viewer.show(recording)
    viewer._playing.value = False
    ((_, ball),), framing = viewer._solids, frame_recording(recording)
    for part in (0.0, 0.5, 1.0):
        viewer.seek(part)
        on_page = np.asarray(ball.position) + viewer._root.position
        assert np.linalg.norm(on_page - framing.targets[0]) < 0.5  # of 30 m
    floor = viewer._server.scene._handle_from_node_name[f"{ROOT}/floor"]
    assert abs(floor.position[0] - 14.75) < 0.5 and floor.width > 28.0
    viewer.show(recordings.cloud(5))
    viewer.seek(1.0)
    np.testing.assert_allclose(viewer._root.position, 0.0, atol=1e-6)


def test_a_mesh_has_the_colours_of_its_particles(viewer, monkeypatch):
    meshes = []
    monkeypatch.setattr(viewer._server.scene, "add_mesh_trimesh", lambda name, mesh: meshes.append(mesh))
    corners = np.array([[0.0, 0.3, 0.0], [1.0, 0.3, 0.0], [0.0, 0.3, 1.0], [1.0, 0.3, 1.0]])
    cloth = recordings.made(
        2, particles=np.stack([corners, corners + 1.0]), triangles=np.array([[0, 2, 1]]), materials=np.array([0, 0, 0, 1]),
        material_names=("cloth", "sand"), thickness=0.02, floor=0.0, values={"load": np.array([[0.0, 0, 0, 1]] * 2)},
    )  # fmt: skip
    viewer.show(cloth)
    viewer._playing.value = False
    colors = {tuple(color[:3]) for color in np.asarray(meshes[-1].visual.vertex_colors).tolist()}
    assert len(colors) == 3  # the cloth's front and back, and sand
    before = len(meshes)
    viewer._by.value = "load"
    viewer._recolor()
    shown = np.asarray(meshes[-1].visual.vertex_colors)[:, :3]
    assert len(meshes) > before and np.ptp(shown[:6], axis=0).max() == 0 and (shown[0] != shown[-1]).any()


def test_particles_are_shown_by_their_surface_until_balls_are_asked_for(viewer, monkeypatch):
    """One surface for each material, moved with the frame; a particle that flies alone is a ball."""
    monkeypatch.setattr(surface, "diameters", None)  # they are computed once, not in each frame
    recording = recordings.cloud(3, 2000, travel=0.1)
    recording.particles[:, 0] += 2.0
    viewer.show(recording)
    viewer._playing.value = False
    viewer.seek(0.0)
    before = viewer.positions()
    extent = np.ptp(before, axis=0)
    assert (extent > 0.4).all() and (extent < 0.6).all()
    assert set(viewer._matter._shown) == {f"{ROOT}/surfaces/0", f"{ROOT}/surfaces/1", f"{ROOT}/loose"}
    np.testing.assert_allclose(viewer._matter._shown[f"{ROOT}/loose"].batched_positions[0], recording.particles[0, 0])
    viewer.seek(1.0)
    np.testing.assert_allclose(viewer.positions().mean(axis=0) - before.mean(axis=0), [0.2, 0.0, 0.0], atol=0.01)
    as_balls(viewer)
    np.testing.assert_allclose(viewer.positions(), recording.particles[2], atol=1e-6)


def test_a_page_that_cannot_be_guarded_is_not_served(monkeypatch):
    stopped = []
    server = types.SimpleNamespace(stop=lambda: stopped.append(True))
    monkeypatch.setattr(pytest.importorskip("viser"), "ViserServer", lambda **options: server)
    with pytest.raises(ValueError, match="cannot be kept from other sites"):
        LiveViewer(port=0)
    assert stopped == [True]


def test_a_taken_port_and_a_missing_package_are_sentences(viewer, monkeypatch):
    taken = int(viewer.url.rsplit(":", 1)[1])
    with pytest.raises(ValueError, match=f"127.0.0.1:{taken} cannot be served .*: choose another port"):
        LiveViewer(port=taken)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ValueError, match=r"a live view needs viser: pip install 'rewax\[live\]'"):
        LiveViewer()


def test_a_particle_is_aball():
    vertices, triangles = ball()
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0, atol=1e-5)
    assert (len(vertices), len(triangles)) == (42, 80)
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    volumes = np.einsum("ni,ni->n", a, np.cross(b, c)) / 6.0
    assert volumes.min() > 0.0 and volumes.sum() == pytest.approx(4.0 / 3.0 * np.pi, rel=0.15)
