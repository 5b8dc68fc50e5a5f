"""Results of a suite: a CSV, a Markdown table beside the paper's numbers, learning curves."""

import csv
import functools
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from rewax.statistics import Curve, interquartile_mean, learning_curve, student_interval
from rewax.training.storage.metrics import read_csv
from rewax.training.suites.suite import Suite
from rewax.whole_files import replacing

COLUMNS: tuple[str, ...] = (
    "task",
    "algorithm",
    "seed",
    "env_steps",
    "sampled",
    "deterministic",
    "success",
    "failed",
    "seconds",
    "wall_seconds",
    "failure",
    "commit",
    "processor",
    "cpp",
    "jax",
)
"""``seconds``: iterations times their median; ``wall_seconds``: compilation, evaluation and interruptions too."""
LATER = ("wall_seconds", "commit", "processor", "cpp", "jax")
"""Columns that files of earlier versions lack."""

_MEASURED = ("sampled", "deterministic", "success", "seconds", "wall_seconds")
_CURVE_COLUMNS = ("task", "algorithm", "seed", "env_steps", "return")
_POINTS = 60  # of a learning curve that is kept

Run: TypeAlias = tuple[str, str, int]
"""Task, algorithm, seed."""

PAPER: dict[str, dict[str, str]] = {
    "AntRun": {
        "ppo": "2048.7 ± 36.6",
        "sac": "2063.6 ± 13.9",
        "trajopt": "915.5 ± 29.6",
        "apg": "258.7 ± 20.3",
        "shac": "3621.0 ± 54.4",
        "sapo": "4535.9 ± 24.5",
    },
    "HandReorient": {
        "ppo": "5.9 ± 4.9",
        "sac": "70.5 ± 10.2",
        "trajopt": "-12.5 ± 2.0",
        "apg": "-11.6 ± 1.9",
        "shac": "-2.5 ± 1.8",
        "sapo": "221.7 ± 9.5",
    },
    "RollingFlat": {
        "ppo": "81.2 ± 0.1",
        "sac": "83.0 ± 0.3",
        "trajopt": "81.5 ± 0.1",
        "apg": "86.9 ± 0.4",
        "shac": "86.8 ± 0.4",
        "sapo": "100.4 ± 0.4",
    },
    "SoftJumper": {
        "ppo": "261.5 ± 12.4",
        "sac": "-161.8 ± 2.5",
        "trajopt": "437.2 ± 17.7",
        "apg": "956.6 ± 15.6",
        "shac": "853.3 ± 10.2",
        "sapo": "1820.5 ± 47.9",
    },
    "HandFlip": {
        "ppo": "7.3 ± 1.1",
        "sac": "4.6 ± 1.1",
        "trajopt": "27.3 ± 2.6",
        "apg": "38.2 ± 3.5",
        "shac": "32.7 ± 2.9",
        "sapo": "90.0 ± 2.2",
        "sapo_hard_targets": "77 ± 3",
        "sapo_hard_return": "59 ± 4",
        "shac2": "56 ± 3",
    },
    "FluidMove": {
        "ppo": "27.3 ± 0.2",
        "sac": "28.2 ± 0.7",
        "trajopt": "27.0 ± 0.1",
        "apg": "26.3 ± 0.3",
        "shac": "21.7 ± 0.4",
        "sapo": "30.6 ± 0.4",
    },
}
"""Returns at scale ``paper`` with sampled actions, mean and 95 % interval over ten seeds (tables 2 and 3)."""


def write_results(
    suite: Suite, rows: Sequence[dict[str, Any]], out_dir: Path, *, pictures: Sequence[str] | None = None
) -> list[str]:
    """Write ``results.csv``, ``curves.csv``, ``table.md`` and one ``<task>.png`` per task.

    Both CSV files keep the runs of other tasks, algorithms and seeds that they hold: the suite may have been larger.

    Args:
      suite: the suite that was run.
      rows: the result of ``runs.rows``.
      out_dir: folder of the files.
      pictures: tasks whose pictures are drawn; by default all.

    Returns:
      A sentence about each file.

    Raises:
      ValueError: one of the CSV files exists and cannot be read; both stay as they are.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    pictures = suite.tasks if pictures is None else pictures
    ours = {_run(row) for row in rows}
    everything = [*rows, *(row for run, row in read_results(out_dir).items() if run not in ours)]
    curves = _curves(everything, out_dir)
    texts = {"results.csv": results_csv(everything), "curves.csv": _curves_csv(curves)}
    texts["table.md"] = markdown(suite, rows)
    for name, text in texts.items():
        with replacing(out_dir / name) as unfinished:
            unfinished.write_text(text, encoding="utf-8")
    drawn = {run: curve for run, curve in curves.items() if run in ours}
    return [f"wrote {out_dir / name}" for name in texts] + _draw_curves(suite, pictures, rows, drawn, out_dir)


def check_readable(out_dir: Path) -> None:
    """Raises ValueError if ``results.csv`` or ``curves.csv`` exists and cannot be read: ``write_results`` would lose
    what it holds."""
    read_results(out_dir)
    _read_curves(out_dir / "curves.csv")


def read_results(out_dir: Path) -> dict[Run, dict[str, Any]]:
    """Rows of ``results.csv``; none if it is missing.

    Raises:
      ValueError: it cannot be read, with the number of the first line that is damaged.
    """
    kinds = {"seed": int, "env_steps": int, "failed": int} | dict.fromkeys(_MEASURED, float)
    needed, columns = ("task", "algorithm", "seed", "sampled"), dict.fromkeys(COLUMNS, str) | kinds
    rows = _read_table(out_dir / "results.csv", columns, needed)
    return {_run(row): {"failure": ""} | row for row in rows}


def _run(row: dict[str, Any]) -> Run:
    return row["task"], row["algorithm"], row["seed"]


def _read_table(path: Path, kinds: Mapping[str, type], needed: Sequence[str]) -> list[dict[str, Any]]:
    """Rows of a CSV file, without what is empty; none if the file is missing.

    Args:
      path: the file.
      kinds: type of each column. Files of earlier versions lack the columns ``LATER``.
      needed: columns that are not empty in any row.

    Raises:
      ValueError: another column, or a row that cannot be read.
    """
    remedy = "restore it, or move it away"
    try:
        text = path.read_text(encoding="utf-8-sig")  # spreadsheets begin a file with a mark
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} cannot be read ({error}): {remedy}") from None
    reader, rows = csv.DictReader(io.StringIO(text, newline="")), []
    header = reader.fieldnames or []
    if missing := [name for name in kinds if name not in (*header, *LATER)]:
        raise ValueError(f"{path} lacks the column {missing[0]!r}: {remedy}")
    if other := [name for name in header if name not in kinds]:
        raise ValueError(f"{path} has another column, {other[0]!r}: {remedy}")
    for row in reader:
        try:
            rows.append({name: kinds[name](row[name]) for name in header if row[name] != ""})
            whole = set(needed) <= set(rows[-1]) and None not in row and None not in row.values()
        except (TypeError, ValueError):
            whole = False
        if not whole:
            raise ValueError(f"line {reader.line_num} of {path} is damaged: {remedy}")
    return rows


def results_csv(rows: Sequence[dict[str, Any]]) -> str:
    """CSV text with one row per run."""
    return _csv(COLUMNS, rows)


def _csv(columns: Sequence[str], rows: Iterable[dict[str, Any]]) -> str:
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def _curves(rows: Sequence[dict[str, Any]], out_dir: Path) -> dict[Run, Curve]:
    """Learning curves of finished runs, from their directories, or from ``curves.csv`` if a directory was removed."""
    kept, curves = _read_curves(out_dir / "curves.csv"), {}
    for row in rows:
        run = _run(row)
        if "env_steps" in row:
            curve = learning_curve(read_csv(out_dir.joinpath("runs", *map(str, run)) / "metrics.csv"))
            curves[run] = _thinned(curve) if curve.steps.size else kept.get(run, curve)
    return curves


def _thinned(curve: Curve) -> Curve:
    if curve.steps.size <= _POINTS:
        return curve
    return curve.at(np.round(np.linspace(curve.steps[0], curve.steps[-1], _POINTS)))


def _curves_csv(curves: Mapping[Run, Curve]) -> str:
    return _csv(
        _CURVE_COLUMNS,
        (
            dict(zip(_CURVE_COLUMNS, (*run, int(steps), f"{value:.6g}"), strict=True))
            for run, curve in curves.items()
            for steps, value in zip(*curve, strict=True)
        ),
    )


def _read_curves(path: Path) -> dict[Run, Curve]:
    kinds: dict[str, type] = dict(zip(_CURVE_COLUMNS, (str, str, int, float, float), strict=True))
    points: dict[Run, list[tuple[float, float]]] = {}
    for row in _read_table(path, kinds, _CURVE_COLUMNS):
        points.setdefault(_run(row), []).append((row["env_steps"], row["return"]))
    return {run: Curve(*np.array(pairs).T) for run, pairs in points.items()}


def markdown(suite: Suite, rows: Sequence[dict[str, Any]]) -> str:
    """One line per task, one column per algorithm: mean return with sampled actions, and from three seeds on its 95 %
    interval by Student's t.

    Parentheses have the number of seeds that failed, which the mean leaves out, and the number that is not done yet.
    Tables of interquartile means and of durations follow. Durations are those of whole runs if all rows have them.
    """
    names = [*dict.fromkeys(row["algorithm"] for row in rows if row["algorithm"] not in suite.algorithms)]
    names += suite.algorithms
    lines = ["| task | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for task in suite.tasks:
        lines.append(f"| {task} | " + " | ".join(_cell(suite, rows, task, name) for name in names) + " |")
        if suite.scale == "paper" and task in PAPER:
            lines.append("| the paper's | " + " | ".join(PAPER[task].get(name, "") for name in names) + " |")
    whole = all("wall_seconds" in row for row in rows if "seconds" in row)
    minutes = "Minutes of a run" if whole else "Minutes of training alone, without compilation and evaluation"
    for title, digest in (
        ("Interquartile means over seeds:", _middle),
        (f"{minutes}, median over seeds:", functools.partial(_minutes, "wall_seconds" if whole else "seconds")),
    ):
        lines += ["", title, "", *lines[:2]]
        for task in [task for task in suite.tasks if any(row["task"] == task for row in rows)]:
            cells = (digest([r for r in rows if (r["task"], r["algorithm"]) == (task, name)]) for name in names)
            lines.append(f"| {task} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _middle(rows: Sequence[dict[str, Any]]) -> str:
    returns = _finite(rows)
    return _number(interquartile_mean(returns)) if returns else ""


def _minutes(measure: str, rows: Sequence[dict[str, Any]]) -> str:
    seconds = [row[measure] for row in rows if measure in row and math.isfinite(row["sampled"])]
    return f"{float(np.median(seconds)) / 60.0:.1f}" if seconds else ""


def _cell(suite: Suite, rows: Sequence[dict[str, Any]], task: str, name: str) -> str:
    done = [row for row in rows if (row["task"], row["algorithm"]) == (task, name)]
    returns = _finite(done)
    if not returns:
        return "failed" if done else ""
    text = _number(sum(returns) / len(returns))
    if len(returns) > 2:
        low, high = student_interval(returns)
        text += f" [{_number(low)}, {_number(high)}]"
    left = len(suite.seeds) - len(done) if name in suite.algorithms else 0
    episodes = sum(row.get("failed", 0) for row in done if math.isfinite(row["sampled"]))
    every = suite.num_eval_episodes * len(returns)
    counts = ((len(done) - len(returns), "failed"), (episodes, f"of {every} episodes failed"), (left, "to do"))
    notes = [f"{count} {what}" for count, what in counts if count]
    return text + (f" ({', '.join(notes)})" if notes else "")


def _finite(rows: Sequence[dict[str, Any]]) -> list[float]:
    """Returns of runs that did not fail."""
    return [row["sampled"] for row in rows if math.isfinite(row["sampled"])]


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.1f}" if abs(value) >= 1 else f"{value:.2g}"


def _draw_curves(
    suite: Suite, tasks: Sequence[str], rows: Sequence[dict[str, Any]], curves: Mapping[Run, Curve], out_dir: Path
) -> list[str]:
    from rewax.viz.curves import curves_of_seeds  # matplotlib is slow to import

    sentences = []
    for task in tasks:
        # All algorithms in the order of the suite, so that each has one colour in all pictures.
        drawn: dict[str, list[Curve]] = {name: [] for name in suite.algorithms}
        failed = {(row["algorithm"], row.get("seed")) for row in rows if row["task"] == task and not _finite([row])}
        for (name, algorithm, seed), curve in curves.items():
            if name == task and curve.steps.size and (algorithm, seed) not in failed:
                drawn[algorithm].append(curve)
        levels = {row["algorithm"]: row["sampled"] for row in rows if row["task"] == task and "env_steps" not in row}
        if any(drawn.values()):
            sentences.append(f"wrote {curves_of_seeds(drawn, out_dir / f'{task}.png', title=task, levels=levels)}")
    return sentences
