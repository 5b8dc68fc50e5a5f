"""A suite is run, interrupted, continued and written down."""

import csv
import dataclasses
import io
import json
import shutil
import signal

import jax
import numpy as np
import pytest
import toys
from rich.console import Console

from rewax.agents import registry as agents
from rewax.agents.registry import Algorithm
from rewax.envs import registry
from rewax.statistics import Curve
from rewax.training.loop.compilation import kept
from rewax.training.storage import description
from rewax.training.storage.run_directory import CannotWrite, hold
from rewax.training.suites import runs as bench
from rewax.training.suites import tables
from rewax.training.suites.runs import BASELINES, Cell, any_failed, in_turn, read_result, run_suite
from rewax.training.suites.suite import Suite
from rewax.training.suites.tables import COLUMNS, markdown, read_results

ENV = toys.point_mass()


@pytest.fixture
def suite(monkeypatch):
    config = dataclasses.make_dataclass(
        "ToyConfig",
        [("num_envs", int, 4), ("horizon", int, 3), ("num_iterations", int, 3), ("noise", float, 0.1)],
        frozen=True,
        namespace={"steps_in": lambda self, env: self.horizon},
    )
    make = lambda env, config: toys.make_toy(env, num_envs=4, horizon=config.horizon, noise=config.noise)  # noqa: E731
    monkeypatch.setitem(registry._FACTORIES, "PointMass", lambda scale: ENV)
    for name, noise in (("calm", 0.1), ("wild", 0.5)):
        preset = lambda env_name, scale, noise=noise: config(noise=noise)  # noqa: E731
        monkeypatch.setitem(agents._ALGORITHMS, name, lambda preset=preset: Algorithm(make, config, preset))
    return Suite(
        name="toy", scale="small", tasks=("PointMass",), algorithms=("calm", "wild"), seeds=(0, 1), num_eval_episodes=8
    )


def run(suite, folder):
    console = Console(file=io.StringIO(), width=200)
    return run_suite(suite, folder, console), console.file.getvalue()


def test_a_suite_leaves_a_table_a_csv_and_curves(suite, tmp_path):
    signum, text = run(suite, tmp_path)
    assert signum == 0 and "run 4 of 4: wild on PointMass, seed 1" in text
    table = (tmp_path / "table.md").read_text().splitlines()
    assert table[0] == "| task | no action | random actions | calm | wild |"
    assert table[2].startswith("| PointMass | -") and "[" not in table[2]  # two seeds say nothing of others
    with (tmp_path / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS and len(rows) == 2 + 4
    trained = [row for row in rows if row["algorithm"] == "calm"]
    assert [int(row["env_steps"]) for row in trained] == [36, 36] and float(trained[0]["seconds"]) > 0
    assert all(float(row["wall_seconds"]) >= float(row["seconds"]) and row["jax"] == jax.__version__ for row in trained)
    older = (
        "task,algorithm,seed,env_steps,sampled,deterministic,success,failed,seconds,failure\nA,sapo,0,9,1.5,2,,0,3,\n"
    )
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "results.csv").write_text(older)
    assert read_results(tmp_path / "old")["A", "sapo", 0]["seconds"] == 3.0
    assert (tmp_path / "PointMass.png").stat().st_size > 5000


def test_the_first_seed_of_everything_comes_first_and_then_those_that_share_programs(suite):
    order = [(cell.algorithm, cell.seed) for cell in in_turn(dataclasses.replace(suite, seeds=(0, 1, 2)))]
    assert order == [("calm", 0), ("wild", 0), ("calm", 1), ("calm", 2), ("wild", 1), ("wild", 2)]


def test_what_is_done_is_skipped_and_the_rest_continued(suite, tmp_path, monkeypatch):
    real, calls = bench.train, []

    def interrupted(agent, env, config, **kwargs):
        calls.append((config.run_dir, config.resume))
        result = real(agent, env, config, **kwargs)
        return result._replace(signum=signal.SIGINT) if len(calls) == 2 else result

    monkeypatch.setattr(bench, "train", interrupted)
    signum, text = run(suite, tmp_path)
    assert signum == signal.SIGINT and len(calls) == 2 and "the same command continues" in text
    before = read_result(Cell("PointMass", "calm", 0).folder(tmp_path))
    here = description.provenance()
    monkeypatch.setattr(description, "provenance", lambda: here | {"commit": "later"})
    monkeypatch.setattr(bench, "provenance", description.provenance)
    assert run(suite, tmp_path)[0] == 0
    rows = read_results(tmp_path)
    found = sorted({str(row["commit"]) for row in rows.values() if row["algorithm"] not in BASELINES})
    assert found == sorted([here["commit"], f"{here['commit']} then later", "later"])
    assert len(calls) == 5 and calls[2] == (calls[1][0], True)  # the interrupted one, from its checkpoint
    assert read_result(Cell("PointMass", "calm", 0).folder(tmp_path)) == before
    assert run(suite, tmp_path)[0] == 0 and len(calls) == 5


def test_results_and_curves_outlive_the_directories_of_runs(suite, tmp_path, monkeypatch):
    assert run(suite.only(tasks=suite.tasks, algorithms=("calm",), seeds=suite.seeds), tmp_path)[0] == 0
    before = {name: (tmp_path / name).read_text() for name in ("results.csv", "curves.csv")}
    curves = list(csv.DictReader(io.StringIO(before["curves.csv"])))
    assert {(row["algorithm"], row["seed"]) for row in curves} == {("calm", "0"), ("calm", "1")}
    shutil.rmtree(tmp_path / "runs")
    monkeypatch.setattr(bench, "_mean_return", lambda *arguments: pytest.fail("baselines were computed again"))
    signum, text = run(suite, tmp_path)
    assert signum == 0 and "run 2 of 4: wild" in text and "calm on" not in text
    for name, text in before.items():
        assert set(text.splitlines()) < set((tmp_path / name).read_text().splitlines())
    assert not (tmp_path / "runs" / "PointMass" / "calm").exists()
    whole = {name: set((tmp_path / name).read_text().splitlines()) for name in before}
    claimed = (tmp_path / "suite.json").stat().st_ino
    smaller = dataclasses.replace(suite, algorithms=("wild",), seeds=(1,))  # as with an edited file
    assert run(smaller, tmp_path)[0] == 0
    for name, lines in whole.items():
        assert set((tmp_path / name).read_text().splitlines()) == lines
    assert "calm" not in (tmp_path / "table.md").read_text() and (tmp_path / "suite.json").stat().st_ino == claimed
    assert run(suite, tmp_path)[0] == 0
    (tmp_path / "curves.csv").unlink()
    (tmp_path / "PointMass.png").unlink()
    shutil.rmtree(tmp_path / "runs")
    assert run(suite, tmp_path)[0] == 0  # nothing to do, and no curve to draw
    assert not (tmp_path / "PointMass.png").exists()


def _kept(folder):
    """Two files as a finished suite leaves them, without run directories."""
    folder.mkdir()
    run = {**dict.fromkeys(COLUMNS, ""), "task": "PointMass", "algorithm": "calm", "env_steps": 36, "sampled": 3.0}
    (folder / "results.csv").write_text(tables.results_csv([{**run, "seed": seed} for seed in (0, 1)]))
    (folder / "curves.csv").write_text("task,algorithm,seed,env_steps,return\nPointMass,calm,0,12,1\n")


@pytest.mark.parametrize(
    ("name", "damage", "sentence"),
    [
        ("results.csv", lambda b: b.replace(b"3.0", b"3.O", 1), r"line 2 of .*results\.csv is damaged: restore it, or"),
        ("results.csv", lambda b: b[:-9], r"line 3 of .*results\.csv is damaged"),
        ("results.csv", lambda b: b + b"\xff", r"results\.csv cannot be read .*: restore it, or move it away"),
        ("results.csv", lambda b: b.replace(b",", b";"), r"results\.csv lacks the column 'task': restore"),
        ("results.csv", lambda b: b.replace(b"task", b"note,task", 1), r"has another column, 'note': restore"),
        ("results.csv", lambda b: b"", r"results\.csv lacks the column 'task'"),
        ("curves.csv", lambda b: b + b"PointMass,calm,1", r"line 3 of .*curves\.csv is damaged"),
    ],
)
def test_what_cannot_be_read_is_not_overwritten(suite, tmp_path, name, damage, sentence):
    folder = tmp_path / "kept"
    _kept(folder)
    path = folder / name
    path.write_bytes(damage(path.read_bytes()))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    new = {"task": "PointMass", "algorithm": "wild", "seed": 0, "sampled": 1.0}
    for write in (lambda: run(suite, folder), lambda: tables.write_results(suite, [new], folder, pictures=())):
        with pytest.raises(ValueError, match=sentence):
            write()
        assert {name: (folder / name).read_bytes() for name in before} == before


def test_a_file_that_a_spreadsheet_has_saved_is_read(suite, tmp_path):
    _kept(tmp_path / "kept")
    for name in ("results.csv", "curves.csv"):
        path = tmp_path / "kept" / name
        path.write_text("\ufeff" + path.read_text().replace("\n", "\r\n"), newline="")
    assert read_results(tmp_path / "kept")["PointMass", "calm", 1]["sampled"] == 3.0
    new = {"task": "PointMass", "algorithm": "wild", "seed": 0, "sampled": 1.0, "deterministic": 1.0}
    tables.write_results(suite, [new], tmp_path / "kept", pictures=())
    assert len(read_results(tmp_path / "kept")) == 3
    assert "PointMass,calm,0,12,1" in (tmp_path / "kept" / "curves.csv").read_text()


def test_a_run_that_fails_is_written_down_and_the_next_one_done(suite, tmp_path, monkeypatch):
    real = bench.train

    def failing(agent, env, config, **kwargs):
        result = real(agent, env, config, **kwargs)
        return result._replace(failure="it fell over", evaluation={}) if "calm/0" in config.run_dir else result

    monkeypatch.setattr(bench, "train", failing)
    assert run(suite, tmp_path)[0] == 0
    row = read_result(Cell("PointMass", "calm", 0).folder(tmp_path))
    assert row["failure"] == "it fell over" and np.isnan(row["sampled"])
    assert " (1 failed) |" in (tmp_path / "table.md").read_text()
    for algorithm, failed in (("calm", True), ("wild", False)):
        part = suite.only(tasks=suite.tasks, algorithms=(algorithm,), seeds=(0,))
        assert any_failed(suite, part, tmp_path) == failed


def test_runs_that_failed_count_neither_for_minutes_nor_for_curves(tmp_path, monkeypatch):
    row = {"task": "PointMass", "algorithm": "calm", "sampled": np.nan, "seconds": 4.0}
    suite = Suite(
        name="one", scale="small", tasks=("Hopper",), algorithms=("sapo",), seeds=(0, 1), num_eval_episodes=64
    )
    cell = {"task": "Hopper", "algorithm": "sapo", "sampled": -4.0, "failed": 63}
    assert (
        tables._cell(suite, [{**cell, "seed": 0}, {**cell, "seed": 1}], "Hopper", "sapo")
        == "-4.0 (126 of 128 episodes failed)"
    )
    minutes = tables._minutes("seconds", [{**row, "seed": 0}, {**row, "seed": 1, "sampled": 1.0, "seconds": 600.0}])
    assert minutes == "10.0"
    drawn = {}
    monkeypatch.setattr("rewax.viz.curves.curves_of_seeds", lambda runs, *args, **kwargs: drawn.update(runs))
    suite = Suite(name="one", scale="small", tasks=("Hopper",), algorithms=("sapo",), seeds=(0, 1))
    rows = [
        {"task": "Hopper", "algorithm": "sapo", "seed": s, "env_steps": 1, "sampled": v}
        for s, v in ((0, np.nan), (1, 2.0))
    ]
    curves = {("Hopper", "sapo", s): Curve(np.array([1.0]), np.array([float(s)])) for s in (0, 1)}
    tables._draw_curves(suite, ["Hopper"], rows, curves, tmp_path)
    assert [curve.returns.tolist() for curve in drawn["sapo"]] == [[1.0]]


def test_an_error_in_one_run_does_not_end_the_suite(suite, tmp_path, monkeypatch):
    real = bench.train

    def failing(agent, env, config, **kwargs):
        if "calm" in config.run_dir:
            raise MemoryError("no room\nat all")
        return real(agent, env, config, **kwargs)

    monkeypatch.setattr(bench, "train", failing)
    signum, text = run(dataclasses.replace(suite, seeds=(0,)), tmp_path)
    assert signum == 0 and "failed: MemoryError: no room at all" in text
    assert "| failed |" in (tmp_path / "table.md").read_text()


def test_a_full_disk_ends_the_suite_which_then_goes_on(suite, tmp_path, monkeypatch):
    suite = dataclasses.replace(suite, seeds=(0,))

    def full(agent, env, config, **kwargs):
        raise CannotWrite("the disk is full: free some space")

    with monkeypatch.context() as patch:
        patch.setattr(bench, "train", full)
        with pytest.raises(CannotWrite, match="free some space"):
            run(suite, tmp_path)
    assert not list(tmp_path.rglob("result.json"))
    assert "run 2 of 2" in run(suite, tmp_path)[1] and "failed" not in (tmp_path / "table.md").read_text()


def test_benchmarks_side_by_side_leave_out_what_the_other_is_at(suite, tmp_path):
    with hold(Cell("PointMass", "calm", 1).folder(tmp_path)):
        signum, text = run(suite.only(tasks=suite.tasks, algorithms=("calm",), seeds=suite.seeds), tmp_path)
    assert signum == 0 and text.count("another process does this run: skipped") == 1
    assert not read_result(Cell("PointMass", "calm", 1).folder(tmp_path))
    assert read_result(Cell("PointMass", "calm", 0).folder(tmp_path))


def test_results_of_other_options_are_not_mixed(suite, tmp_path):
    part = suite.only(tasks=suite.tasks, algorithms=("calm",), seeds=(0,))
    console = Console(file=io.StringIO(), width=200)
    assert run_suite(suite, tmp_path, console, part=part) == 0
    assert "(1 to do)" in (tmp_path / "table.md").read_text()  # of the whole suite
    other = dataclasses.replace(suite, num_eval_episodes=9)
    with pytest.raises(ValueError, match=r"holds results with other num_eval_episodes: choose another directory"):
        run(other, tmp_path)
    stored = json.loads((tmp_path / "suite.json").read_text())
    (tmp_path / "suite.json").write_text(json.dumps({**stored, "gravity": 1}))  # of another version
    with pytest.raises(ValueError, match=r"holds results with other gravity: choose another directory"):
        run(suite, tmp_path)
    (tmp_path / "suite.json").write_text("[1]")
    with pytest.raises(ValueError, match=r"cannot hold results .*: choose another directory \(--out\)"):
        run(suite, tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"file cannot hold results .*: choose another directory \(--out\)"):
        run(suite, tmp_path / "file")


def lacks(row):
    return {name: value for name, value in row.items() if name != "wall_seconds"}


def test_the_table_stands_beside_the_papers():
    suite = Suite(name="p", scale="paper", tasks=("AntRun",), algorithms=("shac", "sapo"), seeds=(0, 1, 2))
    rows = [
        {"task": "AntRun", "algorithm": "sapo", "seed": s, "sampled": 4500.0 + s, "seconds": 60.0 * s} for s in range(3)
    ]
    lines = markdown(suite, rows).splitlines()
    assert lines[2] == "| AntRun |  | 4501 [4499, 4503] |"
    assert lines[3] == "| the paper's | 3621.0 ± 54.4 | 4535.9 ± 24.5 |"
    assert lines[9:11] == ["| AntRun |  | 4501 |", ""]
    assert lines[-1] == "| AntRun |  | 1.0 |"
    assert lines[11] == "Minutes of training alone, without compilation and evaluation, median over seeds:"
    rows = [{**row, "wall_seconds": 120.0} for row in rows]
    for measured, title, last in (
        (rows, "Minutes of a run, ", "2.0"),
        ([*rows[:2], lacks(rows[2])], "training", "1.0"),
    ):
        lines = markdown(suite, measured).splitlines()
        assert title in lines[11] and lines[-1] == f"| AntRun |  | {last} |"


def test_every_run_is_sharded_over_as_many_devices_as_asked(suite, tmp_path, monkeypatch):
    real, asked = bench.train, []

    def noting(agent, env, config, **kwargs):
        asked.append(config.devices)
        return real(agent, env, config, **kwargs)

    monkeypatch.setattr(bench, "train", noting)
    part = suite.only(tasks=suite.tasks[:1], algorithms=suite.algorithms[:1], seeds=suite.seeds[:1])
    assert bench.run_suite(suite, tmp_path, Console(file=io.StringIO()), part=part, devices=1) == 0
    assert asked == [1]


def test_the_seeds_share_environment_and_programs(suite, tmp_path, monkeypatch):
    real, envs, shared = bench.train, [], []

    def noting(agent, env, config, **kwargs):
        envs.append(env)
        shared.append(kept("a program", agent.name, lambda: None)[1])
        return real(agent, env, config, **kwargs)

    monkeypatch.setattr(bench, "train", noting)
    part = suite.only(tasks=suite.tasks, algorithms=suite.algorithms[:1], seeds=suite.seeds)
    assert run_suite(suite, tmp_path, Console(file=io.StringIO()), part=part) == 0
    assert shared == [False, True] and envs[0] is envs[1]


def test_runs_remember_the_modules_that_register_what_they_need(suite, tmp_path):
    part = suite.only(tasks=suite.tasks, algorithms=("calm",), seeds=(0,))
    modules = [{"name": "mine", "folder": "there"}]
    assert run_suite(part, tmp_path, Console(quiet=True), imports=modules) == 0
    config = Cell("PointMass", "calm", 0).folder(tmp_path) / "config.json"
    assert json.loads(config.read_text())["imports"] == modules


def test_an_algorithm_with_shorter_iterations_gets_as_many_steps_as_the_others(suite, tmp_path, monkeypatch):
    known = agents._ALGORITHMS["calm"]()

    def make(env, config):
        toy = known.make(env, config)

        @jax.jit
        def half(state):
            new, metrics = toy.train_step(state)
            return new.replace(env_steps=state.env_steps + 6), metrics

        return toy._replace(train_step=half)

    monkeypatch.setitem(agents._ALGORITHMS, "calm", lambda: known._replace(make=make))
    assert run(suite.only(tasks=suite.tasks, algorithms=suite.algorithms, seeds=(0,)), tmp_path)[0] == 0
    rows = [read_result(Cell("PointMass", name, 0).folder(tmp_path)) for name in ("calm", "wild")]
    assert [row["env_steps"] for row in rows] == [36, 36]
    lines = [
        len((Cell("PointMass", n, 0).folder(tmp_path) / "metrics.csv").read_text().splitlines())
        for n in ("calm", "wild")
    ]
    assert lines == [1 + 6, 1 + 3]
