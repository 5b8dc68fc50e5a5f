"""The page's scripts, run by node: what they read, what keys do, and the numbers at the cursor."""

import json
import re
import subprocess

import numpy as np
import pytest
import recordings
from javascript import NODE, needs_node

from rewax.viz import player
from rewax.viz.player import write_player

pytestmark = needs_node


def in_node(page, names, ask):
    """What a script finds that has the page's text as ``text``, and these scripts of the page."""
    text = re.search(r'<script id="data" type="application/json">(.*?)</script>', page.read_text(), re.DOTALL)[1]
    folder = player.Path(player.__file__).parent
    files = [folder / ("player.js" if name == "player" else f"player_{name}.js") for name in names]
    scripts = "\n".join(file.read_text().partition("\nopen()")[0] for file in files)  # do not open the page
    run = f'const text = require("fs").readFileSync(0, "utf8");\n(async () => {{ {ask} }})()'
    script = f"{scripts}\n{run}.then((found) => process.stdout.write(JSON.stringify(found)));"
    done = subprocess.run([NODE, "-e", script], input=text, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_numbers_may_have_any_name(tmp_path):
    names = ("z", "__proto__", "constructor")
    some = recordings.cloud(
        3, metrics={name: np.array([1.0, 2.0]) for name in names},
        values={name: np.linspace(0.0, i + 1.0, 180).reshape(3, 60) for i, name in enumerate(names)},
    )  # fmt: skip
    page = write_player([some, recordings.cloud(3)], tmp_path / "a.html")
    ask = """
    const [run, other] = (await read(text)).runs;
    const of = (name) => [Array.from(run.metrics[name]), run.particles.values[name].data.length, run.ranges[name][1]];
    return [names.map(of), names.map((name) => [linesOf(other, name)[0].length, other.ranges[name] === undefined])];
    """
    found, other = in_node(page, ("data", "gl", "curves"), f"const names = {json.dumps(names)};{ask}")
    assert found == [[[1.0, 2.0], 180, pytest.approx(i + 1.0, rel=0.02)] for i in range(3)]
    assert other == [[0, True]] * 3


def test_names_of_the_page_stay_its_own(tmp_path):
    heights = np.full((3, 60), 7.0)
    metrics = {"reward": np.array([5.0, 6.0]), "reward (recorded)": np.array([7.0, 8.0])}
    taken = recordings.cloud(3, metrics=metrics, values={"height": heights})
    page = write_player([taken], tmp_path / "a.html")
    ask = """
    const { runs: [run], colors } = await read(text);
    const names = ["", " (recorded)", " (recorded) (recorded)"].map((ending) => `reward${ending}`);
    return [colors, run.ranges, ...names.map((name) => Array.from(linesOf(run, name)[0] || []))];
    """
    colors, ranges, rewards, kept, recorded = in_node(page, ("data", "gl", "curves"), ask)
    assert colors == ["material", "height", "height (recorded)"]
    assert ranges["height"][1] < 0.6 and ranges["height (recorded)"][0] == 7.0
    assert (rewards, kept, recorded) == ([1.0, 1.0], [7.0, 8.0], [5.0, 6.0])


@pytest.mark.parametrize("dt", [1 / 60, 1 / 30, 0.0123456789, float(np.float32(0.02))])
def test_each_step_is_over_at_its_time(tmp_path, dt):
    page = write_player([recordings.moving_ball(300, control_dt=dt)], tmp_path / "a.html")
    ask = "const { runs: [run] } = await read(text); return run.times.map((time) => stepAt(run, time));"
    assert in_node(page, ("data", "gl", "curves"), ask) == list(range(300))


def test_returns_of_a_long_run_are_summed_at_once(tmp_path):
    n = 200_000
    long = recordings.moving_ball(2, steps=np.array([0, n]), rewards=np.ones(n), status=np.zeros(n, int))
    ask = "const { runs: [run] } = await read(text); return [run.totals.length, run.totals[run.rewards.length]];"
    assert in_node(write_player([long], tmp_path / "a.html"), ("data",), ask) == [n + 1, n]


def test_a_run_without_the_chosen_curve_says_so_and_constants_are_drawn(tmp_path):
    acts = recordings.cloud(3, actions=np.ones((2, 2)), metrics={"mass": np.full(2, 1e8)})
    page = write_player([acts, recordings.cloud(3)], tmp_path / "a.html")
    ask = """
    const { runs } = await read(text), said = [];
    const pen = { fillText: (words) => said.push(words), measureText: () => ({ width: 9 }) };
    for (const run of runs) new Curves({}, run).label(pen, 0, "actions", [0, 1]);
    const [low, high] = extentOf(runs, "mass");
    return [said, high > low, extentOf(runs, "actions")];
    """
    said, drawn, extent = in_node(page, ("data", "gl", "curves"), ask)
    assert said == ["actions, 0 to 1:", "this run has no actions"] and drawn
    assert extent == [1.0, pytest.approx(1.0, abs=1e-5)]


def test_with_follow_off_the_floor_is_as_large_as_the_path(tmp_path):
    page = write_player([recordings.moving_ball(60, travel=0.5)], tmp_path / "a.html")
    ask = """
    const { runs: [run] } = await read(text), camera = { azimuth: 0, elevation: 0.4, zoom: 1, shift: [0, 0] };
    const moment = { frame: 59, next: 59, part: 0 };
    return [true, false].map((follow) => {
      const scene = { run, light: [0, 1, 0] };
      Scene.prototype.look.call(scene, moment, camera, { follow }, 400, 300);
      return [scene.target[0], scene.reach, scene.spacing];
    });
    """
    (at, near, fine), (middle, far, coarse) = in_node(page, ("data", "gl", "scene"), ask)
    assert at > 25.0 and middle == pytest.approx(14.75)
    assert near < 5.0 and far > 29.5 and coarse > 4.0 * fine


def test_solids_have_the_look_of_the_nearest_frame_up_to_the_last(tmp_path):
    drawings = [[{**recordings.BALL, "opacity": opacity}] for opacity in (0.125, 0.25, 0.5, 1.0)]
    page = write_player([recordings.made(4, drawings=drawings)], tmp_path / "a.html")
    ask = """
    const { runs: [run] } = await read(text), { times } = run, gl = new Proxy({}, { get: () => () => {} });
    const solids = run.solids.map((solid) => ({ ...solid, array: {} }));
    const looksAt = (time) => {
      const seen = [], { frame, next, part } = momentOf(run, time);
      const scene = { gl, solids, eye: [0, 0, 1], back: [0, 0, 1], use: (_, { paint }) => seen.push(paint[3]) };
      Scene.prototype.drawSolids.call(scene, frame, next, part, false);
      return seen;
    };
    let time = 0;
    const stepped = times.map(() => { const seen = looksAt(time); time += run.dt; return seen; });
    return [times.map(looksAt), stepped, looksAt(times[1] + 0.4 * run.dt), looksAt(times[1] + 0.6 * run.dt)];
    """
    each = [[0.125], [0.25], [0.5], [1.0]]
    assert in_node(page, ("data", "gl", "scene", "player"), ask) == [each, each, [0.25], [0.5]]


def test_the_address_chooses_only_views_that_there_are(tmp_path):
    page = write_player([recordings.moving_ball()], tmp_path / "a.html")
    ask = """
    const chosen = [], player = { runs: [], show: {}, orbit: { view: (name) => chosen.push(name) }, toggle() {} };
    for (const view of ["top", "toString", "none"]) follow(player, new URLSearchParams({ view }));
    return chosen;
    """
    assert in_node(page, ("camera", "seen", "player"), ask) == ["top"]


def test_the_space_bar_plays_unless_a_button_or_a_chooser_takes_it(tmp_path):
    page = write_player([recordings.moving_ball()], tmp_path / "a.html")
    ask = """
    let pressed, count = 0;
    globalThis.document = { getElementById: () => ({ open: false }) };
    globalThis.window = { addEventListener: (_, action) => { pressed = action; } };
    addKeys({ runs: [{ dt: 0.1 }], toggle: () => { count += 1; } });
    return [["BODY"], ["INPUT", "range"], ["INPUT", "text"], ["SELECT"], ["BUTTON"]].map(([tagName, type]) => {
      const before = count;
      pressed({ target: { tagName, type }, key: " ", preventDefault() {} });
      return count > before;
    });
    """
    assert in_node(page, ("controls",), ask) == [True, True, False, False, False]


def test_a_chooser_gives_the_keyboard_back_after_the_mouse_only(tmp_path):
    page = write_player([recordings.moving_ball()], tmp_path / "a.html")
    ask = """
    const actions = [], chosen = [];
    let blurred = 0;
    const select = {
      replaceChildren() {}, closest: () => ({}), blur() { blurred += 1; }, value: "b",
      addEventListener: (kind, action) => actions.push([kind, action]),
    };
    globalThis.document = { getElementById: () => select, createElement: () => ({}) };
    fill("plot", [["a", "a"], ["b", "b"]], "a", (value) => chosen.push(value));
    const send = (kind) => { for (const [known, action] of actions) if (known === kind) action(); return blurred; };
    return [["keydown", "change", "pointerdown", "change"].map(send), chosen];
    """
    assert in_node(page, ("controls",), ask) == [[0, 0, 0, 1], ["a", "a"]]
