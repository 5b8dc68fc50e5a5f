"""Rows that a run must have left, also across resumes with other options."""

from rewax.training.config import ReportConfig
from rewax.training.storage.schedule import continued, due_rows, lost_rows, recorded


def config(log_every, eval_every):
    return ReportConfig(log_every=log_every, eval_every=eval_every)


def test_rows_of_one_segment():
    due = due_rows(continued({}, 0, config(2, 3)), until=6)
    assert due["metrics.csv"] == due["timing.csv"] == {2, 4, 6}
    assert due["eval.csv"] == {0, 3}  # that of 6 follows its checkpoint
    assert due_rows(continued({}, 0, config(1, 0)), until=2) == {
        "metrics.csv": {1, 2}, "timing.csv": {1, 2}, "eval.csv": set(),
    }  # fmt: skip


def test_rows_of_several_segments():
    first = continued({}, 0, config(3, 0))
    second = continued({"schedule": first}, 4, config(1, 5))
    assert due_rows(second, until=6)["metrics.csv"] == {3, 5, 6}
    assert due_rows(second, until=6)["eval.csv"] == {5}
    third = continued({"schedule": second}, 2, config(2, 0))  # the checkpoint of 4 was damaged
    assert [part["after"] for part in third] == [0, 2]
    assert due_rows(third, until=4)["metrics.csv"] == {4}


def test_runs_without_a_schedule():
    stored = {"train": {"log_every": 2, "eval_every": 0, "seed": 0}}
    assert due_rows(continued(stored, 4, config(1, 0)), until=4)["metrics.csv"] == {2, 4}
    assert recorded({}) == recorded({"schedule": [3]}) == recorded({"schedule": None}) == recorded({"train": 1}) == []
    assert due_rows([], until=9)["metrics.csv"] == set()


def test_the_sentence_counts():
    assert lost_rows("metrics.csv", [1, 2, 3], {1, 2, 3}) == ""
    assert lost_rows("metrics.csv", [1, 2, 9], {1, 2}) == ""
    assert "metrics.csv lacks 2 of its 4 rows (iterations 2 to 4)" in lost_rows("metrics.csv", [1, 3], {1, 2, 3, 4})
    assert "eval.csv lacks 1 of its 2 rows (iteration 2)" in lost_rows("eval.csv", [1], {1, 2})


def test_a_run_without_an_evaluation_at_the_start_lacks_no_row():
    schedule = continued({}, 0, ReportConfig(eval_every=2, eval_at_start=False))
    assert due_rows(schedule, 5)["eval.csv"] == {2, 4}
    again = continued({"schedule": schedule}, 3, ReportConfig(eval_every=1, eval_at_start=False))
    assert due_rows(again, 5)["eval.csv"] == {2, 3, 4}
    assert due_rows(continued({}, 0, ReportConfig(eval_every=2)), 5)["eval.csv"] == {0, 2, 4}
