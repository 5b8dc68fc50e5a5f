"""Rows that the CSV files of a run must hold, also if its options changed when it was resumed."""

from collections.abc import Mapping
from typing import Any

from rewax.training.config import ReportConfig

Schedule = list[dict[str, int]]
"""Segments of a run: each holds ``log_every`` and ``eval_every`` from iteration ``after`` on."""


def continued(stored: Mapping[str, Any], iteration: int, config: ReportConfig) -> Schedule:
    """The schedule of a run that continues with ``config``.

    Args:
      stored: contents of its ``config.json``; empty for a new run.
      iteration: from which it continues.
      config: of the new segment.
    """
    new = {"after": iteration, "log_every": config.log_every, "eval_every": config.eval_every}
    if iteration == 0 and not config.eval_at_start:
        new["eval_at_start"] = 0
    return [segment for segment in recorded(stored) if segment["after"] < iteration] + [new]


def recorded(stored: Mapping[str, Any]) -> Schedule:
    """The schedule in a ``config.json``; one segment with the options of ``train`` where there is none."""
    train = stored.get("train")
    schedule = stored.get("schedule", [{"after": 0, **train}] if isinstance(train, Mapping) else [])
    try:
        return [
            {name: int(part[name]) for name in ("after", "log_every", "eval_every")}
            | {"eval_at_start": int(part.get("eval_at_start", 1))}
            for part in schedule
        ]
    except (KeyError, TypeError, ValueError):  # written by hand
        return []


def due_rows(schedule: Schedule, until: int) -> dict[str, set[int]]:
    """Iterations whose rows each file holds when the checkpoint of iteration ``until`` is written.

    A checkpoint is written after the row of its iteration and before its evaluation.
    """
    due: dict[str, set[int]] = {"metrics.csv": set(), "timing.csv": set(), "eval.csv": set()}
    ends = [part["after"] for part in schedule[1:]] + [until]
    for part, end in zip(schedule, ends, strict=False):
        every, end = max(part["log_every"], 1), min(end, until)
        logged = [i for i in range(part["after"] + 1, end + 1) if i % every == 0]
        due["metrics.csv"].update(logged)
        due["timing.csv"].update(logged)
        if every := part["eval_every"]:
            first = part["after"] if part["after"] or part.get("eval_at_start", 1) else 1
            due["eval.csv"].update(i for i in range(first, end) if i % every == 0)
    return due


def lost_rows(name: str, there: list[int], due: set[int]) -> str:
    """A sentence about the missing rows of a file; empty if none is missing."""
    missing = sorted(due - set(there))
    if not missing:
        return ""
    where = f"iteration {missing[0]}" if len(missing) == 1 else f"iterations {missing[0]} to {missing[-1]}"
    return f"warning: {name} lacks {len(missing)} of its {len(due)} rows ({where}): the run goes on without them"
