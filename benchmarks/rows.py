"""Rows of a benchmark's cells in a CSV file, written as the cells are finished."""

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rewax.training.storage.description import provenance
from rewax.whole_files import replacing


def read(path: Path) -> list[dict[str, str]]:
    """The rows that are there, none if there is no file."""
    return list(csv.DictReader(path.open())) if path.is_file() else []


def append(rows: Iterable[Mapping[str, Any]], fields: Sequence[str], path: Path) -> None:
    """Add rows. The file is replaced in one step, so that it is whole at all times."""
    every = [*read(path), *rows]
    with replacing(path) as unfinished, unfinished.open("w", newline="") as file:
        writer = csv.DictWriter(file, fields, lineterminator="\n")
        writer.writeheader()
        writer.writerows(every)


def fill(
    cells: Iterable[Mapping[str, Any]],
    run: Callable[..., Mapping[str, Any] | list[dict[str, Any]]],
    fields: Sequence[str],
    path: Path,
) -> None:
    """Run the cells that have no row yet. Their rows are added as each is finished, with commit and processor.

    Args:
      cells: values by column of the file, which are the arguments of ``run``.
      run: returns the other columns of a cell, of one row or of several.
      fields: columns of the file.
      path: the file.
    """
    where = {key: value for key, value in provenance().items() if key in fields}
    for cell in cells:
        if any(all(row[key] == str(value) for key, value in cell.items()) for row in read(path)):
            continue
        found = run(**cell)
        rows = [{**cell, **row, **where} for row in (found if isinstance(found, list) else [found])]
        append(rows, fields, path)
        for row in rows:
            print(", ".join(map(str, row.values())), flush=True)
        jax.clear_caches()


def returns(rows: Iterable[Mapping[str, str]], **wanted: str) -> list[float]:
    """The returns of the rows with these values."""
    return [float(row["return"]) for row in rows if all(row[key] == value for key, value in wanted.items())]


def mean(rows: Iterable[Mapping[str, str]], **wanted: str) -> str:
    """The mean return of those rows, and their number in brackets; a dash if there are none."""
    found = returns(rows, **wanted)
    return f"{np.mean(found):.1f} ({len(found)})" if found else "-"


def spread(values: Sequence[float], digits: int) -> str:
    """Mean and standard deviation over seeds (n - 1 in the denominator); a dash for the deviation of one seed."""
    deviation = f"{np.std(values, ddof=1):.{digits}f}" if len(values) > 1 else "-"
    return f"{np.mean(values):.{digits}f} ± {deviation}"


__all__ = ["append", "fill", "mean", "read", "returns", "spread"]
