"""``rewax play`` and the videos of ``train`` and ``eval``: what is written, what is refused."""

import json
import re
import shutil
import types

import pytest
import toys

from rewax.cli.main import main
from rewax.envs import registry
from rewax.training.evaluation import pictures
from rewax.training.storage.policies import list_policies

TINY = toys.TINY


@pytest.fixture(scope="module")
def toy():
    """A task with particles under a name, for this file alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._FACTORIES, "ToyForPlay", lambda scale: toys.point_mass(4))
        yield "ToyForPlay"


@pytest.fixture(scope="module")
def run(toy, tmp_path_factory):
    """A trained run with everything that training leaves."""
    folder = tmp_path_factory.mktemp("runs") / "first"
    assert main(["train", f"--env={toy}", "--scale=small", f"--run-dir={folder}", *TINY]) == 0
    return folder


def names_in(page):
    data = re.search(r'<script id="data" type="application/json">(.*?)</script>', page.read_text(), re.DOTALL)[1]
    return [run["name"] for run in json.loads(data)["runs"]], json.loads(data)["runs"]


def test_training_ends_with_a_picture_a_video_and_a_page(run):
    assert (run / "episode.png").stat().st_size > 5_000
    assert b"ftyp" in (run / "episode.mp4").read_bytes()[:16]
    names, (recorded,) = names_in(run / "episode.html")
    assert names == ["first"] and len(recorded["rewards"]) == 4 and recorded["particles"]["count"] == 8


def test_evaluation_ends_with_a_video_unless_it_should_not(run, capsys):
    (run / "episode.mp4").unlink()
    assert main(["eval", f"--run-dir={run}", "--episodes=2", "--no-video"]) == 0
    assert not (run / "episode.mp4").exists() and "episode.mp4" not in capsys.readouterr().out
    assert main(["eval", f"--run-dir={run}", "--episodes=2"]) == 0
    assert (run / "episode.mp4").is_file()
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"wrote {run / 'episode.mp4'}, ")


def test_a_video_that_fails_is_a_sentence_and_the_exit_code_is_0(run, monkeypatch, capsys):
    def fail(recording, path, **options):
        raise OSError("ffmpeg failed; it said: no space left")

    monkeypatch.setattr(pictures, "draw_video", fail)
    assert main(["eval", f"--run-dir={run}", "--episodes=2"]) == 0
    said = capsys.readouterr().out.splitlines()[-1]
    assert said.startswith("warning: episode.mp4 was not drawn (OSError: ffmpeg failed; it said: no space left)")


def test_runs_are_played_side_by_side(run, tmp_path, capsys):
    out = tmp_path / "player.html"
    assert main(["play", str(run), str(run), "--out", str(out), "--frames=3", "--sampled"]) == 0
    names, recorded = names_in(out)
    assert names == [f"{run}, iteration 1"] * 2  # the same last part: the whole path
    assert [len(each["times"]) for each in recorded] == [3, 3] and len(recorded[0]["rewards"]) == 4
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"{run}: 4 steps, return -") and lines[-1].endswith("MB: open it in a browser")


def test_a_wrong_run_is_found_before_an_episode_is_recorded(run, capsys):
    assert main(["play", str(run), "nowhere"]) == 2
    assert capsys.readouterr().out == ""


def _neither(name, guess=""):
    known = ", ".join(sorted({task for task, _ in list_policies()}))
    said = f"{name!r} is neither the directory of a run nor a task with a trained policy: {guess}"
    return f"{said}give a run's directory, or one of {known}"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "rewax play needs 1 to 8 run directories or tasks: rewax play HandFlip"),
        (["a"] * 9, "rewax play needs 1 to 8 run directories or tasks: rewax play HandFlip"),
        (["nowhere"], _neither("nowhere")),
        (["HandFlop"], _neither("HandFlop", "did you mean 'HandFlip'? ")),
        (["RollingFlat", "--live"], "a live view shows a run that trains: rewax play RollingFlat shows its policy"),
        (["a", "--live", "--scale=small"], "a live view shows a run at the scale it trains at: leave out --scale"),
        (["a", "--out=a.mp4"], "out is a.mp4: give an .html file in a folder that exists"),
        (["a", "--out=no/such/a.html"], "out is no/such/a.html: give an .html file in a folder that exists"),
        (["a", "--port=9000"], "--host and --port are of a live page: give --live too, or leave them out"),
        (["a", "--frames=1"], "frames is 1: give an integer of at least 2"),
    ],
)
def test_what_cannot_be_is_one_sentence_and_exit_code_2(arguments, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["play", *arguments]) == 2
    assert capsys.readouterr() == ("", f"error: {said}\n")


def test_a_live_view_shows_each_new_checkpoint_until_interrupted(run, monkeypatch, capsys):
    pytest.importorskip("viser")
    import jax

    from rewax.cli import play
    from rewax.training.storage import checkpoint
    from rewax.training.storage.saved import load_run

    saved, looks = load_run(run), []

    def look(seconds):
        """What a training run does between two looks of the viewer; then the user interrupts."""
        looks.append(seconds)
        if len(looks) > 1:
            raise KeyboardInterrupt
        later = saved.train_state.replace(iteration=saved.train_state.iteration + 1)
        checkpoint.save(run, jax.block_until_ready(later))

    monkeypatch.setattr(play, "time", types.SimpleNamespace(sleep=look))
    assert main(["play", str(run), "--live", "--port=0", "--frames=3"]) == 130
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("http://127.0.0.1:") and said[0].endswith(f"{run}; Ctrl-C ends it")
    assert [line.split(":")[0] for line in said[1:]] == ["iteration 1", "iteration 2"]


def test_a_live_view_shows_a_checkpoint_that_is_written_while_it_starts(run, monkeypatch, capsys):
    pytest.importorskip("viser")
    from rewax.cli import play
    from rewax.training.storage import checkpoint, saved

    load_run, newest = saved.load_run, checkpoint.latest_step(run)

    def slowly(directory):
        loaded = load_run(directory)
        checkpoint.save(run, loaded.train_state.replace(iteration=loaded.train_state.iteration + 1))
        return loaded

    def interrupt(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr(saved, "load_run", slowly)
    monkeypatch.setattr(play, "time", types.SimpleNamespace(sleep=interrupt))
    assert main(["play", str(run), "--live", "--port=0", "--frames=3"]) == 130
    said = capsys.readouterr().out.splitlines()[1:]
    assert [line.split(":")[0] for line in said] == [f"iteration {newest}", f"iteration {newest + 1}"]


def test_a_live_view_passes_over_a_damaged_checkpoint_once(run, monkeypatch, capsys, recwarn):
    pytest.importorskip("viser")
    from rewax.cli import play
    from rewax.training.storage import checkpoint

    newest, looks = checkpoint.latest_step(run), []

    def look(seconds):
        """A checkpoint that cannot be read appears; at the third look the user interrupts."""
        looks.append(seconds)
        if len(looks) == 1:
            damaged = run / "checkpoints" / str(newest + 1)
            shutil.copytree(run / "checkpoints" / str(newest), damaged)
            for path in damaged.rglob("*"):
                if path.is_file() and path.name != "leaves.json":
                    path.write_bytes(b"")
        if len(looks) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(play, "time", types.SimpleNamespace(sleep=look))
    assert main(["play", str(run), "--live", "--port=0", "--frames=3"]) == 130
    said = capsys.readouterr().out.splitlines()[1:]
    assert [line.split(":")[0] for line in said] == [f"iteration {newest}"] * 2
    shutil.rmtree(run / "checkpoints" / str(newest + 1))


def test_a_live_view_is_of_one_run(run, capsys):
    assert main(["play", str(run), str(run), "--live"]) == 2
    assert capsys.readouterr().err.startswith("error: a live view shows the newest checkpoint of one run: give one run")
