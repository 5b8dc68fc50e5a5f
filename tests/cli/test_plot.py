"""``rewax plot``: which runs share a curve, what is written, what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from rewax.cli.main import main


def make_run(folder, name, agent="sapo", returns=(1.0, 2.0, 3.0)):
    run = folder / name
    run.mkdir()
    rows = "".join(f"{i + 1},{100 * (i + 1)},{value}\n" for i, value in enumerate(returns))
    (run / "metrics.csv").write_text(f"iteration,env_steps,return\n{rows}")
    (run / "config.json").write_text(json.dumps({"agent": agent, "env": "RollingFlat", "scale": "small"}))
    return str(run)


@pytest.fixture
def runs(tmp_path):
    return [make_run(tmp_path, f"{agent}-{seed}", agent) for agent in ("sapo", "shac") for seed in (0, 1)]


def drawn(monkeypatch):
    """What the picture gets."""
    from rewax.viz import curves

    seen, real = {}, curves.curves_of_seeds

    def note(groups, out, **options):
        seen.update(groups)
        return real(groups, out, **options)

    monkeypatch.setattr(curves, "curves_of_seeds", note)
    return seen


def test_seeds_of_a_configuration_are_one_curve(runs, tmp_path, monkeypatch, capsys):
    seen, out = drawn(monkeypatch), tmp_path / "made" / "curves.png"
    assert main(["plot", *runs, "--out", str(out)]) == 0
    assert {name: len(group) for name, group in seen.items()} == {
        "sapo RollingFlat small": 2,
        "shac RollingFlat small": 2,
    }
    np.testing.assert_array_equal(seen["sapo RollingFlat small"][0].steps, [100.0, 200.0, 300.0])
    assert imread(out).std() > 0.01
    assert capsys.readouterr().out == f"wrote {out}\n"


def test_runs_can_be_curves_of_their_own_and_pictures_vectors(runs, tmp_path, monkeypatch):
    seen, out = drawn(monkeypatch), tmp_path / "curves.svg"
    assert main(["plot", *runs, "--by", "run", "--out", str(out)]) == 0
    assert list(seen) == ["sapo-0", "sapo-1", "shac-0", "shac-1"]
    assert out.read_text().lstrip().startswith("<?xml")


def test_dollar_signs_in_names_and_titles_are_shown(tmp_path):
    run, out = make_run(tmp_path, "cost_$\\bad$"), tmp_path / "curves.svg"
    assert main(["plot", run, "--by", "run", "--title", "$\\frac{$", "--out", str(out)]) == 0
    assert "<!-- $\\frac{$ -->" in out.read_text() and "<!-- cost_$\\bad$ (1) -->" in out.read_text()


def test_runs_of_one_name_are_told_apart_and_all_are_drawn(tmp_path, monkeypatch):
    folders = [tmp_path / str(i) for i in range(40)]
    for folder in folders:
        folder.mkdir()
    seen, out, same = drawn(monkeypatch), tmp_path / "curves.svg", [make_run(folder, "_seed0") for folder in folders]
    assert main(["plot", *same, "--by", "run", "--out", str(out)]) == 0
    assert list(seen) == same and all(path in out.read_text() for path in same)


def test_a_run_without_a_finished_episode_is_named(runs, tmp_path, capsys):
    early, out = make_run(tmp_path, "early", returns=("nan",)), tmp_path / "curves.svg"
    assert main(["plot", runs[0], early, "--out", str(out)]) == 0
    said = f"note: no episode of {early} has ended, so it has no curve\nwrote {out}\n"
    assert capsys.readouterr().out == said
    (Path(early) / "metrics.csv").write_text("")  # it has just begun
    assert main(["plot", runs[0], early, "--out", str(out)]) == 0
    assert capsys.readouterr().out == said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "rewax plot needs one or more run directories"),
        (["nowhere"], "nowhere holds no metrics.csv: give the directories of runs"),
        (["{run}", "--out", "curves.jpg"], "curves.jpg does not end in .png, .svg, .pdf"),
        (["{run}", "--by", "seed"], "--by is 'seed': use config"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(arguments, said, runs, capsys):
    assert main(["plot", *(a.replace("{run}", runs[0]) for a in arguments)]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
