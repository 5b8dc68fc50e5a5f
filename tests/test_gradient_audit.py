"""benchmarks/gradient_audit: rewax's own questions at a tiny size, and what the table says of other outcomes."""

import contextlib
import dataclasses
import importlib
import json
import math
import sys
import types
from pathlib import Path

import jax
import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks" / "gradient_audit"
MODULES = ("audit_scenes", "audit_protocol", "audit_table", "audit_worker")


@contextlib.contextmanager
def in_folder():
    """The modules of the audit lie beside its command and import each other by name."""
    sys.path.insert(0, str(FOLDER))
    try:
        yield
    finally:
        sys.path.remove(str(FOLDER))


with in_folder():
    scenes, protocol, table, worker = (importlib.import_module(name) for name in MODULES)
    with_rewax = importlib.import_module("with_rewax")


@pytest.fixture(autouse=True)
def precision_as_before():
    before = jax.config.jax_enable_x64
    yield
    jax.config.update("jax_enable_x64", before)


@pytest.mark.parametrize(
    ("variant", "scene", "size"),
    [
        ("rewax", "throw", 0.2),
        ("rewax", "press", 0.2),
        ("rewax", "slide", 0.1),
        ("rewax", "drop", 0.2),
        pytest.param("rewax", "slide-rigid", 0.1, marks=pytest.mark.slow),
        ("rewax", "foot", 0.7),
        pytest.param("rewax (MuJoCo's law)", "foot", 0.7, marks=pytest.mark.slow),
    ],
)
def test_gradients_of_rewax_are_the_slopes_of_what_it_computes(variant, scene, size):
    start = scenes.SCENES[scene].starts(1)[0]
    problem = with_rewax.build(variant, scene, size)
    gradient = problem.gradient(start)
    found = [
        [protocol.difference(problem.value, start, axis, step, "float64") for step in (1e-5, 1e-6)] for axis in range(2)
    ]
    slope = np.array(
        [steps[int(np.argmin(np.abs(steps - g)))] for steps, g in zip(np.array(found), gradient, strict=True)]
    )
    numbers = protocol.compare(gradient[None], slope[None])
    assert numbers["zeros"] == numbers["nans"] == 0.0
    assert np.all(np.abs(slope) > 0)
    assert numbers["error"] < 1e-6


def problem(gradient):
    """The value is p0^2 + sin p1."""
    return protocol.Problem(
        value=lambda p: p[0] ** 2 + np.sin(p[1]), gradient=lambda p: np.array(gradient(p)), precision="float64"
    )


def row_of(made):
    def build(variant, scene):
        if isinstance(made, Exception):
            raise made
        return made

    return worker.row_of(types.SimpleNamespace(VERSION="1.2", build=build), "fake", "throw", 3)


def test_a_right_gradient_has_no_zeros_and_a_small_error():
    row = row_of(problem(lambda p: [2 * p[0], np.cos(p[1])]))
    assert (row.status, row.entries, row.zeros, row.nans) == ("measured", 6, 0.0, 0.0)
    assert row.worst < 1e-8 and row.difference_error < 1e-8
    assert 0 < row.wide_error < 1e-3, "the difference over a wide step is another number"


def test_a_silent_zero_is_counted_and_shown():
    row = row_of(problem(lambda p: [2 * p[0], 0.0]))
    assert row.zeros == 0.5 and row.nans == 0.0
    starts = scenes.SCENES["throw"].starts(3)
    missing = np.abs(np.cos(starts[:, 1]))
    expected = missing / np.hypot(missing, 2 * starts[:, 0])
    assert row.error == pytest.approx(np.median(expected), rel=1e-6)
    assert "| 50 % | 0 % |" in table.markdown([row])


def test_a_true_zero_is_not_counted():
    flat = protocol.Problem(value=lambda p: p[0], gradient=lambda p: np.array([1.0, 0.0]), precision="float64")
    assert row_of(flat).zeros == 0.0


def test_nan_is_counted_and_shown():
    row = row_of(problem(lambda p: [np.nan, np.cos(p[1])]))
    assert row.nans == 0.5 and row.zeros == 0.0 and math.isinf(row.error)
    assert "| 0 % | 50 % | not finite |" in table.markdown([row])


def test_differences_in_float32_are_of_fourth_order():
    cubic = lambda p: p[0] ** 3  # noqa: E731
    at = np.array([1.0])
    assert protocol.difference(cubic, at, 0, 0.1, "float32") == pytest.approx(3.0, abs=1e-12)
    assert protocol.difference(cubic, at, 0, 0.1, "float64") == pytest.approx(3.01, abs=1e-12)


@pytest.mark.parametrize(
    ("error", "status", "note"),
    [
        (protocol.NotSupported("no particles"), "not supported", "no particles"),
        (protocol.NotTried("not written"), "not tried", "not written"),
        (ValueError("bad\nmore"), "failed", "ValueError: bad"),
    ],
)
def test_what_cannot_be_measured_is_a_row(error, status, note):
    row = row_of(error)
    assert (row.status, row.note, row.version, row.zeros) == (status, note, "1.2", None)
    assert f"| fake 1.2 | {status}: {note} |" in table.markdown([row])


def test_a_missing_simulator_is_a_row(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["audit_worker.py", "with_nothing_of_this_name", "absent", "throw", "1"])
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", sys.stdout)
        worker.main()
    row = protocol.Row(**json.loads(capsys.readouterr().out.splitlines()[-1]))
    assert row.status == "not installed" and "with_nothing_of_this_name" in row.note
    assert "| absent | not installed: " in table.markdown([row])


def test_files_hold_what_was_measured(tmp_path):
    rows = [
        row_of(problem(lambda p: [np.nan, 1.0])),
        protocol.Row(simulator="absent", scene="foot", status="not installed"),
    ]
    table.write(rows, tmp_path)
    assert table.read(tmp_path) == [dataclasses.replace(row) for row in rows]
    lines = (tmp_path / "gradient_audit.csv").read_text().splitlines()
    assert len(lines) == 3 and lines[0].startswith("simulator,scene,status")
    assert (tmp_path / "gradient_audit.md").read_text() == table.markdown(rows)
