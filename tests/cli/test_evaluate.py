"""``rewax eval``: numbers as lines, as JSON and over a grid of parameters; options are checked before any work."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax import struct
from rewax.cli.main import main
from rewax.envs import registry
from rewax.envs.latency import Latency
from rewax.envs.randomize import Scale, Uniform, hook, leaves
from rewax.envs.randomized import Randomized
from rewax.training.evaluation import episodes, landscape
from rewax.training.evaluation.sweep import read_grid, with_parameters

TOY = "ToyForEvaluation"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Directory of a run of one iteration."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._FACTORIES, TOY, lambda scale: toys.point_mass(4))
        argv = ["train", f"--env={TOY}", "--scale=small", f"--run-dir={folder}", *toys.TINY]
        assert main([*argv, "--train.no-plots"]) == 0
        yield folder


def test_numbers_are_printed_and_kept_as_json(run, capsys):
    assert main(["eval", str(run), "--episodes=3", "--no-video"]) == 0
    text, kept = capsys.readouterr().out, json.loads((run / "eval.json").read_text())
    assert (kept["iteration"], kept["episodes"], kept["seed"]) == (1, 3, 0)
    for name in ("sampled", "deterministic"):
        numbers = kept[name]
        assert f"{name:13s} mean {numbers['mean']:.4g} [" in text
        assert numbers["mean"] == pytest.approx(sum(numbers["returns"]) / 3) and len(numbers["returns"]) == 3
        assert numbers["interval"][0] <= numbers["mean"] <= numbers["interval"][1]


def test_a_full_disk_keeps_the_old_numbers(run, tmp_path, capsys):
    """In a process of its own, whose files may have 4 KiB."""
    kept = (run / "eval.json").read_bytes() if (run / "eval.json").exists() else b""
    (run / "eval.json").write_text("{}")
    program = (
        "import resource, signal, sys\nfrom pathlib import Path\nfrom rewax.cli import main as cli\n"
        "from rewax.cli.evaluate import _write_json\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\nresource.setrlimit(resource.RLIMIT_FSIZE, (64, 64))\n"
        "cli._run = lambda argv: print(_write_json(Path(argv[0]), {'a': list(range(100))}))\n"
        "sys.exit(cli.main(sys.argv[1:]))"
    )
    ended = subprocess.run([sys.executable, "-c", program, run / "eval.json"], capture_output=True, text=True)
    assert ended.returncode == 1 and ended.stderr.count("\n") == 1
    assert "cannot be written (File too large): free some space" in ended.stderr
    assert (run / "eval.json").read_text() == "{}" and len(list(run.glob(".writing*"))) == 0
    (run / "eval.json").write_bytes(kept or b"{}")


def test_baselines_are_those_of_the_same_starts(run, tmp_path, capsys):
    out = tmp_path / "with_baselines.json"
    assert main(["eval", str(run), "--episodes=3", "--no-video", "--baselines", f"--json={out}"]) == 0
    text, kept = capsys.readouterr().out, json.loads(out.read_text())
    assert main(["eval", str(run), "--episodes=3", "--no-video", "--set=gain=0", f"--json={out}"]) == 0
    powerless = json.loads(out.read_text())["grid"][0]["deterministic"]["returns"]
    assert kept["no action"]["returns"] == pytest.approx(powerless, rel=1e-5)
    assert kept["random actions"]["returns"] != pytest.approx(powerless, rel=1e-5)
    assert f"{'random actions':14s} mean {kept['random actions']['mean']:.4g} [" in text


def test_a_grid_of_a_parameter_is_a_table(run, tmp_path, capsys):
    out = tmp_path / "grid.json"
    assert main(["eval", str(run), "--episodes=3", "--no-video", "--set=gain=0,0.5", f"--json={out}"]) == 0
    lines, grid = capsys.readouterr().out.splitlines(), json.loads(out.read_text())["grid"]
    assert lines[1].split()[:2] == ["gain", "sampled"] and len(lines) == 5
    assert [point["parameters"] for point in grid] == [{"gain": 0.0}, {"gain": 0.5}]
    still, moved = (point["deterministic"]["returns"] for point in grid)
    assert main(["eval", str(run), "--episodes=3", "--no-video", f"--json={out}"]) == 0
    assert moved == pytest.approx(json.loads(out.read_text())["deterministic"]["returns"], rel=1e-5)
    starts = [(-total / 4) ** 0.5 for total in still]  # a point that stays at x earns -x^2 in each of 4 steps
    assert all(0.5 <= start <= 1.5 for start in starts) and still != moved


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (["--baselines", "--set=gain=1"], "--baselines evaluates without --set: leave one of them out"),
        (["--color-by=smell"], "particles cannot be coloured by 'smell': use one of material, height"),
        (["--set=gain"], "--set is 'gain': write parameter=value or parameter=value1,value2,..."),
        (["--set=gain=fast"], "--set gives gain the value 'fast': give a finite number"),
        (["--set=gains=1"], "PointMass has no parameter 'gains': near are gain; "),
        (["--set=gain=1", "--set=gain=2"], "--set names gain twice: give all its values at once"),
        (["--video-size", "7", "8"], "video-size is 7 8: give even numbers from 2 on"),
        (["--video-path=nowhere/a.mp4"], "video-path is nowhere/a.mp4: give a file .mp4 in a folder that exists"),
        (["--json=folder.json"], "json is folder.json: give a file .json in a folder that exists"),
        (["--json=a.txt"], "json is a.txt: give a file .json in a folder that exists"),
        (["--no-video", "--video-path=a.mp4"], "--video-path is of a video, and --no-video makes none: leave one out"),
        (["--no-video", "--no-surface"], "--no-surface is of a video, and --no-video makes none: leave one out"),
        (["--no-video", "--color-by=height"], "--color-by is of a video, and --no-video makes none: leave one out"),
        (["--seed=-1"], "seed is -1: give an integer from 0 to 4294967295"),
    ],
)
def test_options_are_refused_before_an_episode_is_computed(run, tmp_path, monkeypatch, capsys, argv, sentence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.json").mkdir()
    monkeypatch.setattr(episodes, "_evaluate", lambda *args: pytest.fail("evaluated first"))
    assert main(["eval", str(run), *argv]) == 2
    assert sentence in capsys.readouterr().err


def test_a_landscape_is_computed_only_if_it_can_be_written(run, monkeypatch, capsys):
    def full(path, *args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(landscape, "landscape", lambda *args, **kwargs: pytest.fail("computed first"))
    monkeypatch.setattr(Path, "touch", full)
    for where in ([f"--run-dir={run}"], [str(run)]):
        assert main(["landscape", *where]) == 1
        assert "No space left on device" in capsys.readouterr().err
    assert main(["landscape"]) == 2
    assert "rewax landscape needs one run directory" in capsys.readouterr().err


def test_the_video_has_the_size_and_place_that_are_asked_for(run, tmp_path, capsys):
    path = tmp_path / "small.mp4"
    argv = ["--episodes=1", "--video-size", "64", "48", f"--video-path={path}", "--color-by=height"]
    assert main(["eval", str(run), *argv]) == 0
    assert f"wrote {path}" in capsys.readouterr().out
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(path))
    assert next(reader)["size"] == (64, 48)
    reader.close()


@struct.dataclass
class Nested(toys.PointMass):
    """A point mass in which two names end alike."""

    floor: toys.PointMass = struct.field(default_factory=toys.point_mass)
    parameters: dict = struct.field(default_factory=lambda: {"damping": jnp.float32(0.1)})


def test_a_full_name_is_the_parameter_itself():
    env = Nested(gain=jnp.float32(1.0))
    names = leaves(env)
    assert {"gain", "floor.gain", "parameters[damping]"} <= set(names)
    assert list(read_grid(["gain=0.3"], env)) == ["gain"]
    assert list(read_grid(["damping=0.3"], env)) == ["parameters[damping]"]


@struct.dataclass
class Things(toys.PointMass):
    """A point mass with an array that nothing uses."""

    start: jax.Array = struct.field(default_factory=lambda: jnp.ones(3))


def test_a_value_that_is_set_is_not_drawn():
    env = toys.point_mass(4)
    draws = hook({"gain": Scale(Uniform(0.5, 2.0))})
    drawn = Latency(env=Randomized(env=env, randomize=draws), observation=1)
    ((name, (value,)),) = read_grid(["gain=0.3"], drawn).items()
    fixed = with_parameters(drawn, {name: value})
    states = [fixed.reset(jax.random.key(i)) for i in range(2)]
    moved = [fixed.step(state, jnp.ones(1)).physics - state.physics for state in states]
    np.testing.assert_allclose(moved, 0.3, rtol=1e-5)
    assert drawn.reset(jax.random.key(0)).drawn[".gain"] != drawn.reset(jax.random.key(1)).drawn[".gain"]
    several = Randomized(
        env=Things(start=jnp.ones(3), gain=jnp.float32(1.0)),
        randomize=hook({"start": Scale(Uniform(0.5, 2.0)), "gain": Uniform(5.0, 6.0)}),
    )
    kept = with_parameters(several, {"env.start": 2.0})
    assert [names for names, _ in kept.randomize.draws] == [("gain",)]
    with pytest.raises(
        ValueError, match=r"^start\[1\] is drawn at every reset together with the rest of start: set all"
    ):
        with_parameters(several, {"env.start[1]": 3.0, "env.gain": 3.0})
    own = Randomized(env=env, randomize=lambda key, env: env.replace(gain=env.gain * jax.random.uniform(key)))
    with pytest.raises(ValueError, match="gain is drawn at every reset by a function, so it has no value to set"):
        with_parameters(own, {"env.gain": 0.3})
