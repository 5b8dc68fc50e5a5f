"""Benchmarks report what differs, what failed and what they lack."""

import sys

import numpy as np
import pytest
from doc_pages import ROOT, run_benchmark


def test_no_benchmark_hides_a_module_of_python():
    """The folder is the first place where its scripts, and the libraries that they use, look for modules."""
    assert not {path.stem for path in (ROOT / "benchmarks").glob("*.py")} & sys.stdlib_module_names


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        ([1.0, np.nan], [1.0, np.nan], "1 of 1 equal"),
        ([1.0, 2.0], [1.0, 2.5], "0 of 1 equal, largest difference 2.5e-01: a"),
        ([1.0, 2.0], [1.0, np.nan], "0 of 1 equal, largest difference inf: a"),
        ([np.nan, 2.0], [1.0, 2.0], "0 of 1 equal, largest difference inf: a"),
        ([-0.0, np.inf], [0.0, np.inf], "0 of 1 equal, largest difference 0.0e+00: a"),
        ([1.0, 2.0], [1.0], "0 of 1 equal, largest difference inf: a"),
        (np.zeros(1, int), np.zeros(1), "0 of 1 equal, largest difference 0.0e+00: a (int64, now float64)"),
        ([1.0], None, "0 of 1 equal, only before: a"),
        (None, [1.0], "0 of 1 equal, only after: a"),
    ],
)
def test_values_of_two_checkouts_that_differ_are_told(before, after, told):
    files = [{} if values is None else {"Task|reset|a": np.asarray(values)} for values in (before, after)]
    assert [line.split(maxsplit=2) for line in run_benchmark("golden")["compare"](*files)] == [["Task", "reset", told]]


def test_the_spread_of_seeds_is_that_of_a_sample():
    spread = run_benchmark("rows")["spread"]
    assert spread([1.0, 3.0], 2) == "2.00 ± 1.41" and spread([5.0], 1) == "5.0 ± -"


@pytest.mark.parametrize("what", ["forward", "train_step"])
def test_peak_memory_is_that_of_the_process_that_compiles_nothing(what, monkeypatch):
    names, repeats = run_benchmark("speed"), []

    def run_worker(args, what, task, scale, cache, count):
        repeats.append(count)
        cold = len(repeats) == 1
        milliseconds = np.inf if count == 0 else 1.0 if cold else 2.0
        return {"compile_s": 9.0 if cold else 1.0, "run_ms": milliseconds, "peak_gb": 8.0 if cold else 2.0}

    measure = names["measure_cold_and_warm"]
    monkeypatch.setitem(measure.__globals__, "run_worker", run_worker)
    found = measure(names["Args"](repeats=5), what, "RollingFlat", "small")
    once = what == "train_step"
    assert repeats == [0 if once else 5, 5] and found["run_ms"] == (2.0 if once else 1.0)
    assert (found["compile_cold_s"], found["compile_s"], found["peak_gb"]) == (9.0, 1.0, 2.0)


@pytest.mark.parametrize("python", ["/bin/false", "/nowhere/python"])
def test_without_newton_the_cloth_is_not_timed(python, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["thin_speed.py", "--newton", python, "--sizes", "1000", "--turns", "1"])
    names = run_benchmark("thin_speed")
    monkeypatch.setitem(names["main"].__globals__, "compare", None)
    with pytest.raises(SystemExit, match=f"^{python} has no newton and warp-lang: give --newton"):
        names["main"]()


def test_help_starts_no_measurement(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["hand_contact.py", "--help"])
    names = run_benchmark("hand_contact")
    monkeypatch.setitem(names["main"].__globals__, "rewax", None)
    with pytest.raises(SystemExit) as ended:
        names["main"]()
    assert ended.value.code == 0 and "How deep HandReorient's cube sinks" in capsys.readouterr().out


def test_shares_of_pixels_leave_out_the_background():
    names = run_benchmark("camera_depth")
    ours, theirs = np.full((2, 10, 10), names["FAR"])
    ours[0, :3], theirs[0, :2], theirs[0, 3] = 1.0, 1.0, 1.0
    share, error = names["agreement"](ours, theirs)
    assert share == 0.5 and error == pytest.approx(0.5 * (names["FAR"] - 1.0))


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({}, 0),
        ({"reward": [1.0005, 2e-8]}, 0),
        ({"reward": [1.01, 0.0]}, 1),
        ({"state": [np.nan, 1.0]}, 1),
        ({"status": [0, 4]}, 1),
        ("raises", 1),
    ],
)
def test_a_device_that_computes_something_else_is_a_failure(change, code, monkeypatch, capsys):
    names, devices = run_benchmark("gpu_agreement"), []
    inside = names["main"].__globals__
    same = {
        "reward": [1.0, 0.0], "state": [1.0, 1.0], "gradient by action": [1.0], "gradient by state": [1e-8],
        "status": [0, 0],
    }  # fmt: skip

    def run(args, task, device, state, action):
        devices.append(device)
        if len(devices) == 2 and change == "raises":
            raise ValueError("no memory")
        found = same if len(devices) == 1 else same | change
        return [{name: np.asarray(values) for name, values in found.items()}] * 2

    monkeypatch.setitem(inside, "run", run)
    monkeypatch.setitem(inside, "start", lambda *_: (None, None))
    monkeypatch.setitem(inside, "enable_compilation_cache", lambda: None)
    assert names["main"](names["Args"](tasks=("RollingFlat",))) == code
    assert "RollingFlat" in capsys.readouterr().out


def test_repeats_that_differ_excuse_devices_that_differ():
    agrees = run_benchmark("gpu_agreement")["agrees"]
    ones = np.ones(3)
    assert agrees(ones, 1.02 * ones, 1.03 * ones) and not agrees(ones, 1.04 * ones, 1.03 * ones)
