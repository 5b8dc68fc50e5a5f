"""Rows as a table for readers (markdown) and for programs (JSON, CSV)."""

import csv
import dataclasses
import json
import math
from pathlib import Path

from audit_protocol import Row
from audit_scenes import SCENES

COLUMNS = (
    "simulator", "zeros", "NaN", "error, median", "worst", "slope known to", "error by wide difference", "seconds",
    "MB",
)  # fmt: skip


def share(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.0f} %"


def number(value: float | None) -> str:
    if value is None:
        return ""
    return "not finite" if not math.isfinite(value) else f"{value:.1e}"


def cells(row: Row) -> list[str]:
    """What a row shows, as many cells as there are columns."""
    name = f"{row.simulator} {row.version}".strip()
    if row.status != "measured":
        note = f": {row.note}" if row.note else ""
        return [name, f"{row.status}{note}".replace("|", "/"), *[""] * (len(COLUMNS) - 2)]
    memory = (
        "" if row.memory_mb is None or row.base_mb is None else f"{row.base_mb:.0f} + {row.memory_mb - row.base_mb:.0f}"
    )
    seconds = "" if row.seconds is None else f"{row.seconds:.2g}"
    precision = "" if row.precision == "float64" else f" ({row.precision})"
    errors = [number(e) for e in (row.error, row.worst, row.difference_error, row.wide_error)]
    return [name + precision, share(row.zeros), share(row.nans), *errors, seconds, memory]


def markdown(rows: list[Row]) -> str:
    """One table for each scene, in the order of the scenes."""
    parts = []
    for name, scene in SCENES.items():
        found = [row for row in rows if row.scene == name]
        if not found:
            continue
        parts.append(f"### {name}: {scene.title}\n\nd({scene.outcome}) / d({', '.join(scene.parameters)})\n")
        parts.append("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
        parts += ["| " + " | ".join(cells(row)) + " |" for row in found]
        parts.append("")
    return "\n".join(parts)


def finite(value: object) -> object:
    """JSON has no infinity."""
    return "not finite" if isinstance(value, float) and not math.isfinite(value) else value


def read(folder: Path) -> list[Row]:
    """Rows that ``write`` left in a folder; none if there is no such file."""
    path = folder / "gradient_audit.json"
    plain = json.loads(path.read_text()) if path.exists() else []
    return [Row(**{key: math.inf if value == "not finite" else value for key, value in row.items()}) for row in plain]


def write(rows: list[Row], folder: Path) -> None:
    """Writes gradient_audit.md, .json and .csv."""
    folder.mkdir(parents=True, exist_ok=True)
    plain = [{key: finite(value) for key, value in dataclasses.asdict(row).items()} for row in rows]
    (folder / "gradient_audit.md").write_text(markdown(rows))
    (folder / "gradient_audit.json").write_text(json.dumps(plain, indent=1, allow_nan=False) + "\n")
    with (folder / "gradient_audit.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=[field.name for field in dataclasses.fields(Row)])
        writer.writeheader()
        writer.writerows(plain)
