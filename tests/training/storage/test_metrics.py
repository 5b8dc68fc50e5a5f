"""CSV files that a resumed run continues as if it had never stopped."""

import importlib.machinery
import sys
import types

import numpy as np
import pytest

from rewax.training.storage.metrics import CsvWriter, TensorBoardWriter, WandbWriter, read_csv


def rows(first, last):
    return [
        (i, {"env_steps": 10 * i, "return": np.float32(np.nan if i == 1 else 0.1 * i)}) for i in range(first, last + 1)
    ]


def write(path, some_rows, **kwargs):
    writer = CsvWriter(path, **kwargs)
    for iteration, values in some_rows:
        writer.write(iteration, values)
    writer.close()


def test_reads_back_what_was_written(tmp_path):
    write(tmp_path / "a.csv", rows(1, 3))
    columns = read_csv(tmp_path / "a.csv")
    assert list(columns) == ["iteration", "env_steps", "return"]
    np.testing.assert_array_equal(columns["iteration"], [1, 2, 3])
    np.testing.assert_array_equal(columns["return"].astype(np.float32), np.float32([np.nan, 0.2, 0.3]))
    assert (tmp_path / "a.csv").read_text().splitlines()[2] == "2,20,0.2"


@pytest.mark.parametrize("number", [np.float32(1 / 3), np.float64(1 / 3), np.float32(1e-30), np.int32(-7)])
def test_numbers_survive_exactly(tmp_path, number):
    write(tmp_path / "a.csv", [(1, {"x": number})])
    assert read_csv(tmp_path / "a.csv")["x"].astype(number.dtype)[0] == number


def test_resumed_file_equals_an_uninterrupted_one(tmp_path):
    whole, parts = tmp_path / "whole.csv", tmp_path / "parts.csv"
    write(whole, rows(1, 8))
    write(parts, rows(1, 6))
    with parts.open("a") as file:
        file.write("7,7")  # cut short by a crash
    write(parts, rows(5, 8), resume_at=4)
    assert parts.read_bytes() == whole.read_bytes()


def test_each_row_is_on_disk_at_once(tmp_path):
    writer = CsvWriter(tmp_path / "a.csv")
    writer.write(1, {"x": 1.0})
    assert (tmp_path / "a.csv").read_text() == "iteration,x\n1,1.0\n"
    writer.close()


def test_other_names_than_the_header_are_refused(tmp_path):
    writer = CsvWriter(tmp_path / "a.csv")
    writer.write(1, {"x": 1.0})
    with pytest.raises(ValueError, match=r"row 2 .* differs from the first in \['x', 'y'\]"):
        writer.write(2, {"y": 1.0})
    writer.close()


def test_a_resumed_file_takes_names_that_came_and_went(tmp_path):
    write(tmp_path / "a.csv", [(1, {"x": 1, "old": 2}), (2, {"x": 3, "old": 4}), (3, {"x": 0, "old": 0})])
    write(tmp_path / "a.csv", [(3, {"new": 5, "x": 6}), (4, {"new": 7, "x": 8})], resume_at=2)
    assert (tmp_path / "a.csv").read_text().split() == ["iteration,x,old,new", "1,1,2,", "2,3,4,", "3,6,,5", "4,8,,7"]
    write(tmp_path / "a.csv", [(5, {"x": 9})], resume_at=4)
    assert (tmp_path / "a.csv").read_text().split()[-1] == "5,9,,"
    np.testing.assert_array_equal(read_csv(tmp_path / "a.csv")["new"], [np.nan, np.nan, 5, 7, np.nan])


def test_a_missing_file_has_no_columns(tmp_path):
    assert read_csv(tmp_path / "none.csv") == {}


def test_tensorboard_writes_events(tmp_path):
    writer = TensorBoardWriter(tmp_path)
    writer.write(1, {"return": np.float32(2.0), "nothing": np.float32(np.nan)})
    writer.close()
    (events,) = tmp_path.glob("events*")
    content = events.read_bytes()
    assert b"train/return" in content and b"train/nothing" not in content


def test_a_damaged_file_keeps_what_can_be_read(tmp_path):
    path = tmp_path / "a.csv"
    write(path, rows(1, 4))
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([lines[0], lines[1], "2,2\n", "oops,1,2\n", lines[4]]))
    writer = CsvWriter(path, resume_at=4)
    assert writer.iterations == [1, 4] and writer.last_iteration == 4
    writer.close()
    np.testing.assert_array_equal(read_csv(path)["iteration"], [1, 4])


def test_a_file_without_its_header_is_set_aside(tmp_path):
    path = tmp_path / "a.csv"
    write(path, rows(1, 4))
    beheaded = path.read_text().partition("\n")[2]
    path.write_text(beheaded)
    write(path, rows(5, 5), resume_at=4)
    np.testing.assert_array_equal(read_csv(path)["iteration"], [5])
    assert (tmp_path / "a.csv.damaged").read_text() == beheaded


class FakeWandb(types.ModuleType):
    """What rewax uses of wandb, kept in lists; the real one needs an account or seconds of another process."""

    def __init__(self):
        super().__init__("wandb")
        self.__spec__ = importlib.machinery.ModuleSpec("wandb", None)
        self.runs, self.active = [], None

    def init(self, **options):
        if self.active is None or options.get("reinit") == "create_new":
            self.active = FakeRun(self, options)
            self.runs.append(self.active)
        return self.active


class FakeRun:
    """A page: its options, rows and axes."""

    def __init__(self, wandb, options):
        self.wandb, self.options, self.logged, self.axes, self.ended = wandb, options, [], [], 0

    def define_metric(self, name, step_metric=None):
        self.axes.append((name, step_metric))

    def log(self, values):
        self.logged.append(values)

    def finish(self):
        self.ended, self.wandb.active = self.ended + 1, None


def test_weights_and_biases_get_finite_numbers_and_resumed_runs_go_on_in_their_place(tmp_path, monkeypatch):
    fake = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    for iteration in (1, 2):
        writer = WandbWriter("dough", tmp_path, {"env": "RollingFlat"})
        writer.write(iteration, {"return": np.float32(0.5), "loss": np.float32(np.nan)})
        writer.write(iteration, {"mean": 2.0}, prefix="eval")
        writer.close()
    (first, again) = [(run.options["project"], run.options["name"], run.options["id"]) for run in fake.runs]
    assert first == again and first[:2] == ("dough", tmp_path.name) and len(first[2]) == 8
    page = fake.runs[0]
    assert page.options["resume"] == "allow" and page.options["config"] == {"env": "RollingFlat"}
    assert page.logged == [{"iteration": 1, "train/return": 0.5}, {"iteration": 1, "eval/mean": 2.0}]
    assert ("*", "iteration") in page.axes and [run.ended for run in fake.runs] == [1, 1]


def test_seeds_side_by_side_have_a_page_each_on_weights_and_biases(tmp_path, monkeypatch):
    fake = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    for seed in (0, 1):
        (tmp_path / str(seed)).mkdir()
    writers = [WandbWriter("dough", tmp_path / str(seed), {}) for seed in (0, 1)]
    for seed, writer in enumerate(writers):
        writer.write(1, {"return": float(seed)})
    assert [run.logged for run in fake.runs] == [[{"iteration": 1, "train/return": float(seed)}] for seed in (0, 1)]


def test_without_weights_and_biases_there_is_a_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "meta_path", [])
    monkeypatch.setattr(sys, "path", [])
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    with pytest.raises(ValueError, match=r"train.wandb needs Weights & Biases: pip install 'rewax\[wandb\]'"):
        WandbWriter("dough", tmp_path, {})
