"""The page holds what was recorded, needs no network, and moves what it shows when the time is moved."""

import base64
import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import zlib

import matplotlib.image
import numpy as np
import pytest
import recordings

from rewax.viz import player
from rewax.viz.camera import frame_recording
from rewax.viz.colors import MATERIALS, SCALE
from rewax.viz.player import MAX_RUNS, SCRIPTS, write_player
from rewax.viz.recording import diameters
from rewax.viz.seen import LABELS, NOTHING, Seen

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next((path for path in map(shutil.which, BROWSERS) if path), None)
_PATIENCE = 120
"""How long the browser may take to open a page [s]."""
EVIL = "<img src=x onerror=\"document.title='broken in'\">"
needs_browser = pytest.mark.skipif(BROWSER is None, reason=f"no browser: none of {', '.join(BROWSERS)} is installed")


def scene(num_frames=5, travel=0.1):
    """Particles and a half transparent capsule that move along x."""
    capsule = {
        "kind": "capsule",
        "radius": 0.05,
        "half_length": 0.2,
        "direction": np.array([0.0, 1.0, 1.0]),
        "opacity": 0.5,
    }
    drawings = [[{**capsule, "center": np.array([travel * i, 0.8, 0.0])}] for i in range(num_frames)]
    status = np.array([0, 4, 0, 1] * num_frames)[: num_frames - 1]
    return recordings.cloud(
        num_frames, num_particles=200, travel=travel, drawings=drawings, status=status, camera={"follow": False},
        actions=np.arange(2 * num_frames - 2).reshape(-1, 2), metrics={"height": np.arange(num_frames - 1.0, 0.0, -1.0)},
    )  # fmt: skip


def data_of(path):
    text = re.search(r'<script id="data" type="application/json">(.*?)</script>', path.read_text(), re.DOTALL)[1]
    return json.loads(text)


def decoded(blob):
    """Numbers as the page's scripts read them."""
    content = zlib.decompress(base64.b64decode(blob["z"]))
    if "frames" not in blob:
        return np.frombuffer(content, f"<{blob['type']}")
    planes = np.frombuffer(content, np.uint8)
    if blob["type"] == "u2":
        low, high = planes.reshape(2, -1).astype(np.uint16)
        planes = low | (high << 8)
    return np.cumsum(planes.reshape(blob["frames"], -1), axis=0, dtype=planes.dtype)


def test_positions_values_poses_and_curves_come_back(tmp_path):
    recording = scene()
    (run,) = data_of(write_player([recording], tmp_path / "a.html"))["runs"]
    cloud = run["particles"]
    positions = decoded(cloud["positions"]).reshape(5, 200, 3) / 65535.0 * cloud["size"] + cloud["low"]
    np.testing.assert_allclose(positions, recording.particles, atol=max(cloud["size"]) / 65535.0)
    speed = cloud["values"]["speed"]
    values = decoded(speed["data"]) / 255.0 * (speed["high"] - speed["low"]) + speed["low"]
    expected = np.clip(recording.values["speed"], speed["low"], speed["high"])
    np.testing.assert_allclose(values, expected, atol=0.51 * (speed["high"] - speed["low"]) / 255.0)
    poses = decoded(run["solids"][0]["poses"]).reshape(5, 7)
    np.testing.assert_allclose(poses[:, :3], [shapes[0]["center"] for shapes in recording.drawings], atol=1e-6)
    assert run["solids"][0]["opacity"] == 0.5 and decoded(run["solids"][0]["triangles"]).max() < 2000
    assert run["rewards"] == [1.0] * 4 and run["status"] == [0, 4, 0, 1]
    assert run["times"] == recording.times.tolist()
    assert run["num_actions"] == 2 and decoded(run["actions"]).tolist() == [0, 1, 2, 3, 4, 5, 6, 7]
    assert decoded(run["metrics"]["height"]).tolist() == [4.0, 3.0, 2.0, 1.0]


def test_each_material_has_its_particles_diameter_and_colour(tmp_path):
    recording = scene()
    (run,) = data_of(write_player([recording], tmp_path / "a.html"))["runs"]
    water, dough = run["particles"]["parts"]
    assert decoded(water["members"]).tolist() == list(range(0, 200, 2))
    assert decoded(dough["members"]).tolist() == list(range(1, 200, 2))
    for part, name in ((water, "water"), (dough, "dough")):
        np.testing.assert_allclose(part["color"], MATERIALS[name], atol=1e-5)
        members = decoded(part["members"])
        assert part["diameter"] == pytest.approx(diameters(recording)[members].mean())


def test_the_page_may_follow_what_moves_or_stand_still(tmp_path):
    recording = recordings.moving_ball(9, travel=0.4)
    (run,) = data_of(write_player([recording], tmp_path / "a.html"))["runs"]
    followed, still = (frame_recording(dataclasses.replace(recording, camera={"follow": on})) for on in (True, False))
    assert run["follow"] and len(run["still"]["targets"]) == 3
    np.testing.assert_allclose(np.reshape(run["followed"]["targets"], (9, 3)), followed.targets, atol=1e-5)
    np.testing.assert_allclose(run["still"]["targets"], still.targets[0], atol=1e-5)
    assert run["still"]["distance"] == still.distance > run["followed"]["distance"] == followed.distance


def test_a_marker_that_grows_and_turns_green_is_two_solids(tmp_path):
    red, green = (
        {"kind": "sphere", "center": np.zeros(3), "radius": radius, "color": color}
        for radius, color in ((0.1, (1.0, 0.0, 0.0)), (0.5, (0.0, 1.0, 0.0)))
    )
    path = write_player([recordings.made(3, drawings=[[red], [red], [green]])], tmp_path / "a.html")
    first, then = data_of(path)["runs"][0]["solids"]
    assert decoded(first["shown"]).tolist() == [1, 1, 0] and decoded(then["shown"]).tolist() == [0, 0, 1]
    assert first["color"] == [1.0, 0.0, 0.0] and then["color"] == [0.0, 1.0, 0.0]
    assert np.abs(decoded(then["vertices"])).max() == pytest.approx(0.5, rel=0.01)


def test_a_mesh_is_in_the_page_once_and_its_poses_once_a_frame(tmp_path):
    rng = np.random.default_rng(0)
    body = {"kind": "mesh", "vertices": rng.uniform(-1.0, 1.0, (3000, 3)), "triangles": np.arange(3000).reshape(-1, 3)}
    sizes = []
    for num_frames in (2, 60):
        drawings = [
            [{**body, "center": np.array([0.1 * i, 2.0, 0.0]), "rotation": np.eye(3)}] for i in range(num_frames)
        ]
        path = write_player([recordings.made(num_frames, drawings=drawings)], tmp_path / "a.html")
        sizes.append(path.stat().st_size)
    assert sizes[1] < sizes[0] + 20_000 < 400_000
    (solid,) = data_of(path)["runs"][0]["solids"]
    vertices, triangles = decoded(solid["vertices"]).reshape(-1, 3), decoded(solid["triangles"]).reshape(-1, 3)
    found = vertices[triangles].sum(axis=1)
    np.testing.assert_allclose(found, body["vertices"].reshape(-1, 3, 3).sum(axis=1), atol=1e-5)
    np.testing.assert_allclose(
        decoded(solid["poses"]).reshape(60, 7)[-1], [5.9, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0], atol=1e-6
    )


def test_the_page_is_one_file_that_asks_for_nothing_and_is_small(tmp_path):
    frames, count = 300, 2500
    walk = np.cumsum(np.random.default_rng(0).normal(0.0, 2e-4, (frames, count, 3)), axis=0)
    particles = (np.random.default_rng(1).uniform(0.0, 0.4, (count, 3)) + walk).astype(np.float32)
    values = {name: np.linalg.norm(walk, axis=-1) for name in ("speed", "strain")}
    recording = recordings.made(frames, particles=particles, values=values, floor=0.0, name="</script><b>")
    path = write_player([recording], tmp_path / "a.html", title="a < b")
    text = path.read_text()
    assert path.stat().st_size < 10e6
    assert not re.search(r"\b(src|href)\s*=|https?://|@import|fetch\(|url\(", re.sub(r'"z":"[^"]*"', "", text))
    assert "<title>a &lt; b</title>" in text and "{{" not in re.sub(r'"z":"[^"]*"', "", text)
    assert data_of(path)["runs"][0]["name"] == "</script><b>"
    assert [file.name for file in tmp_path.iterdir()] == ["a.html"]


def test_a_page_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    path = write_player([recordings.moving_ball()], tmp_path / "a.html")
    before = path.read_text()

    def full(file, text, **options):
        file.write_bytes(text[:1000].encode())
        raise OSError("no space left")

    monkeypatch.setattr(player.Path, "write_text", full)
    with pytest.raises(OSError, match="no space left"):
        write_player([recordings.moving_ball(99)], path)
    assert path.read_text() == before and [file.name for file in tmp_path.iterdir()] == ["a.html"]


def test_a_title_may_be_a_directory_whose_name_is_not_utf8(tmp_path):
    path = write_player([recordings.moving_ball(name="a\udce9")], tmp_path / "a.html", title="runs/a\udce9")
    assert "<title>runs/a?</title>" in path.read_text() and data_of(path)["runs"][0]["name"] == "a\udce9"


def test_constant_and_missing_values_have_a_colour_without_warnings(tmp_path):
    values = {"large": np.full((5, 60), 1e8, np.float32), "missing": np.full((5, 60), np.nan)}
    values["partly"] = np.where(np.arange(60) < 30, np.nan, 2.0) * np.ones((5, 1))
    (run,) = data_of(write_player([recordings.cloud(values=values)], tmp_path / "a.html"))["runs"]
    for value in run["particles"]["values"].values():
        assert value["high"] > value["low"] and not decoded(value["data"]).any()
        assert np.float32(value["high"]) > np.float32(value["low"])  # as the graphics card has them


def test_scripts_set_names_as_text_and_every_script_is_small():
    folder = player.Path(player.__file__).parent
    assert sorted(SCRIPTS) == sorted(file.name for file in folder.glob("*.js"))
    for name in SCRIPTS:
        text = (folder / name).read_text()
        assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(", text), name
        assert len(text.splitlines()) < 400


def test_too_few_and_too_many_runs_are_refused(tmp_path):
    for some in ([], [recordings.moving_ball()] * (MAX_RUNS + 1)):
        with pytest.raises(ValueError, match=f"a page plays 1 to 8 recordings, not {len(some)}"):
            write_player(some, tmp_path / "a.html")


def browse(path, moment, screenshot, *, more="", size=(1200, 700)):
    """Open the page at a moment: its document when it has settled, and what it wrote to the console."""
    command = [
        str(BROWSER), "--headless=new", "--no-sandbox", "--disable-gpu-sandbox", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--hide-scrollbars", f"--window-size={size[0]},{size[1]}",
        f"--user-data-dir={screenshot.with_suffix('')}", "--enable-logging=stderr", "--virtual-time-budget=4000",
        f"--screenshot={screenshot}", "--dump-dom", f"file://{path}#t={moment}{more}",
    ]  # fmt: skip
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True)
    try:
        document, errors = process.communicate(timeout=_PATIENCE)
    except subprocess.TimeoutExpired:  # seen where other programs kept all cores busy
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        pytest.skip(f"the browser gave no answer within {_PATIENCE} s")
    console = [line for line in errors.splitlines() if "CONSOLE" in line]
    return document, console, matplotlib.image.imread(screenshot)[..., :3]


@needs_browser
def test_a_browser_shows_it_without_errors_and_moving_the_time_moves_it(tmp_path):
    path = write_player([scene(travel=0.1), recordings.moving_ball(name="a ball")], tmp_path / "a.html")
    images = []
    for moment in (0.0, 0.08):
        document, console, image = browse(path, moment, tmp_path / f"{moment}.png", more="&balls")
        assert not console, console
        assert 'data-state="ready"' in document and "a ball" in document
        images.append(image)
    assert "step 4" in document and "NAN" in document  # the status of the last step
    scenes = [image[100:450, 10:590] for image in images]
    blue = [np.nonzero(image[..., 2] > 1.6 * image[..., 0])[1] for image in scenes]  # water
    assert min(len(columns) for columns in blue) > 100
    assert blue[1].mean() > blue[0].mean() + 20.0  # to the right
    assert scenes[0].std() > 0.05
    other = [image[100:450, 610:1190] for image in images]
    np.testing.assert_allclose(other[0], other[1], atol=0.02)  # the ball rests


def seeing_scene(name="depth"):
    """The scene with a camera whose picture is dark blue on the left, and whose right half sees nothing."""
    pixels = np.full((5, 16, 16), NOTHING, np.uint8)
    pixels[:, :, :8] = np.arange(0, 250, 50)[:, None, None]
    bodies = np.where(pixels < NOTHING, 1, NOTHING).astype(np.uint8)
    depth = Seen(name=name, kind="depth", pixels=pixels, near=0.5, far=2.0)
    return dataclasses.replace(
        scene(), seen=[depth, Seen(name=name, kind="bodies", pixels=bodies, names=("tool", EVIL))]
    )


def test_what_cameras_show_comes_back(tmp_path):
    recording = seeing_scene()
    (run,) = data_of(write_player([recording], tmp_path / "a.html"))["runs"]
    for stored, seen in zip(run["seen"], recording.seen, strict=True):
        np.testing.assert_array_equal(decoded(stored["pixels"]).reshape(5, 16, 16), seen.pixels)
        assert stored["title"] == seen.title and stored["names"] == list(seen.names)
        np.testing.assert_allclose(np.reshape(stored["colors"], (256, 3)), 255 * seen.colors(), atol=0.5)
    assert (run["seen"][0]["near"], run["seen"][0]["far"]) == (0.5, 2.0)


@needs_browser
def test_the_cameras_picture_is_in_the_corner_and_can_be_chosen_enlarged_and_hidden(tmp_path):
    path = write_player([seeing_scene(), scene()], tmp_path / "a.html")
    shares = {}
    for more in ("&run=1", "&run=1&large", "&run=1&camera=depth:", "&run=1&camera=none", "&run=2"):
        _, console, image = browse(path, 0.0, tmp_path / f"{len(shares)}.png", more=more)
        assert not console, console
        for color, of in ((SCALE[0], "depth"), (LABELS[1], "bodies")):
            shares[more, of] = (np.abs(image[80:560] - color).max(axis=-1) < 0.02).mean()
    assert shares["&run=1", "depth"] > 0.01 and shares["&run=1&large", "depth"] > 2.0 * shares["&run=1", "depth"]
    assert shares["&run=1&camera=depth:", "bodies"] > 0.01 > 0.001 > shares["&run=1&camera=depth:", "depth"]
    for more in ("&run=1&camera=none", "&run=2"):
        assert shares[more, "depth"] < 0.001


@needs_browser
def test_names_from_recordings_stay_text_and_surfaces_are_smooth(tmp_path):
    axis = np.arange(-6, 7) * 0.05
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    points = points[np.linalg.norm(points, axis=1) <= 0.3] + [0.0, 0.5, 0.0]
    values = {EVIL: np.stack([points[:, 0]] * 3)}
    ball = recordings.made(
        3, particles=np.stack([points] * 3).astype(np.float32), material_names=("water",), values=values, name=EVIL,
        floor=0.0, metrics={EVIL: np.arange(2.0)}, camera={"azimuth": 0.0},
    )  # fmt: skip
    path = write_player([ball, ball], tmp_path / "a.html", title="safe {{data}}")
    images = {}
    for shown in ("", "&balls"):
        document, console, images[shown] = browse(path, 0.02, tmp_path / f"{len(images)}.png", more=f"&run=1{shown}")
        assert not console and "<title>safe {{data}}</title>" in document
        assert document.count("&lt;img src=x") >= 4 and "<img" not in document
    rough = {}
    for shown, image in images.items():
        blue = image[100:500, 300:900]
        blue = np.where((blue[..., 2] > 1.3 * blue[..., 0])[..., None], blue, np.nan).mean(axis=-1)
        assert np.isfinite(blue).sum() > 5000
        rough[shown] = np.nanmean(np.abs(np.diff(blue, axis=1)))
    assert rough[""] < 0.5 * rough["&balls"]


@needs_browser
def test_a_phone_shows_one_run_at_a_time(tmp_path):
    path = write_player([scene()] * 4, tmp_path / "a.html")
    document, console, _ = browse(
        path, 0.0, tmp_path / "a.png", size=(520, 844)
    )  # windows of Chromium have 500 pixels or more
    assert not console
    sections = re.findall(r"<section([^>]*)>", document.partition('<main id="runs"')[2].partition("</main>")[0])
    assert len(sections) == 4 and ["hidden" in section for section in sections] == [False, True, True, True]


@needs_browser
def test_a_page_that_cannot_play_says_so(tmp_path):
    path = write_player([recordings.moving_ball()], tmp_path / "a.html")
    path.write_text(path.read_text().replace('"webgl2"', '"none"'))
    document, _, _ = browse(path, 0, tmp_path / "a.png")
    assert 'data-state="failed"' in document and "Cannot play this: this browser offers no WebGL 2" in document
