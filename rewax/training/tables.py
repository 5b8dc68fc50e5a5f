"""Results of a suite: one CSV, a Markdown table beside the paper's numbers, learning curves."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rewax.statistics import bootstrap_interval, interquartile_mean
from rewax.training.metrics import read_csv
from rewax.training.suite import Suite

COLUMNS: tuple[str, ...] = (
    "task",
    "algorithm",
    "seed",
    "env_steps",
    "sampled",
    "deterministic",
    "failed",
    "seconds",
    "failure",
)

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


def write_results(suite: Suite, rows: Sequence[dict[str, Any]], out_dir: Path) -> list[str]:
    """Write ``results.csv``, ``table.md`` and one ``<task>.png`` per task.

    Args:
      suite: that was run.
      rows: as ``bench.rows`` gives them.
      out_dir: where to.

    Returns:
      A sentence about each file.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    written = [out_dir / "results.csv", out_dir / "table.md"]
    written[0].write_text(results_csv(rows))
    written[1].write_text(markdown(suite, rows))
    return [f"wrote {path}" for path in written] + _draw_curves(suite, rows, out_dir)


def results_csv(rows: Sequence[dict[str, Any]]) -> str:
    """All runs, one row each."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, COLUMNS, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def markdown(suite: Suite, rows: Sequence[dict[str, Any]]) -> str:
    """One line per task, one column per algorithm: mean return with sampled actions, and its 95 % bootstrap interval
    over seeds. Brackets say where seeds have failed, which are left out, or are not done yet.
    """
    names = [*dict.fromkeys(row["algorithm"] for row in rows if row["algorithm"] not in suite.algorithms)]
    names += suite.algorithms
    lines = ["| task | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for task in suite.tasks:
        lines.append(f"| {task} | " + " | ".join(_cell(suite, rows, task, name) for name in names) + " |")
        if suite.scale == "paper" and task in PAPER:
            lines.append("| the paper's | " + " | ".join(PAPER[task].get(name, "") for name in names) + " |")
    middle = ["", "Interquartile means over seeds:", "", lines[0], lines[1]]
    for task in suite.tasks:
        cells = [_returns(rows, task, name) for name in names]
        middle.append(f"| {task} | " + " | ".join(_number(interquartile_mean(c)) if c else "" for c in cells) + " |")
    return "\n".join(lines + middle) + "\n"


def _cell(suite: Suite, rows: Sequence[dict[str, Any]], task: str, name: str) -> str:
    returns = _returns(rows, task, name)
    if not returns:
        return "failed" if any(row["task"] == task and row["algorithm"] == name for row in rows) else ""
    if len(returns) == 1:
        text = _number(returns[0])
    else:
        low, high = bootstrap_interval(returns)
        text = f"{_number(sum(returns) / len(returns))} [{_number(low)}, {_number(high)}]"
    done = [row for row in rows if row["task"] == task and row["algorithm"] == name]
    left = len(suite.seeds) - len(done) if name in suite.algorithms else 0
    notes = [f"{count} {what}" for count, what in ((len(done) - len(returns), "failed"), (left, "to do")) if count]
    return text + (f" ({', '.join(notes)})" if notes else "")


def _returns(rows: Sequence[dict[str, Any]], task: str, name: str) -> list[float]:
    found = [row["sampled"] for row in rows if row["task"] == task and row["algorithm"] == name]
    return [value for value in found if math.isfinite(value)]


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.1f}" if abs(value) >= 1 else f"{value:.2g}"


def _draw_curves(suite: Suite, rows: Sequence[dict[str, Any]], out_dir: Path) -> list[str]:
    from rewax.viz.curves import curves_with_intervals  # matplotlib is slow to import

    said = []
    for task in suite.tasks:
        curves: dict[str, list[Any]] = {}
        for row in rows:
            folder = out_dir / "runs" / task / row["algorithm"] / str(row["seed"])
            if row["task"] == task and "env_steps" in row:
                curves.setdefault(row["algorithm"], []).append(read_csv(folder / "metrics.csv"))
        levels = {row["algorithm"]: row["sampled"] for row in rows if row["task"] == task and "env_steps" not in row}
        if curves:
            said.append(f"wrote {curves_with_intervals(curves, out_dir / f'{task}.png', title=task, levels=levels)}")
    return said
