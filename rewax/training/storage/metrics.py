"""Writers of metrics: CSV always, TensorBoard by default, Weights & Biases on request.

``metrics.csv`` and ``eval.csv`` contain no times; these are in ``timing.csv``. On a CPU, two runs with the same seed
therefore write the same bytes. A resumed run also writes the same bytes as an uninterrupted one.
"""

import contextlib
import csv
import importlib.util
import io
import math
import secrets
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rewax.whole_files import replacing


class CsvWriter:
    """Appends rows of named numbers to a CSV file; each row is flushed to disk.

    The first row determines the header. A resumed run appends to the existing file, after incomplete rows and rows of
    iterations after ``resume_at`` are removed. An existing file without a header is renamed to ``<name>.damaged``.
    Names that are new since then become columns, empty in the old rows; names that are gone stay, empty in the new
    rows.

    Args:
      path: path of the file.
      resume_at: iteration that the run continues from; 0 starts an empty file.

    Attributes:
      iterations: iterations of the rows kept from the existing file.
      last_iteration: iteration of the last row, -1 without rows.
    """

    def __init__(self, path: str | Path, *, resume_at: int = 0) -> None:
        self._path = Path(path)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._header, rows = _read_rows(self._path) if resume_at else ([], [])
        rows = [row for row in rows if int(row[0]) <= resume_at]
        self.iterations = [int(row[0]) for row in rows]
        self.last_iteration = self.iterations[-1] if rows else -1
        if resume_at and not self._header and self._path.is_file() and self._path.stat().st_size:
            self._path.replace(self._path.with_name(self._path.name + ".damaged"))
        with replacing(self._path) as unfinished:
            unfinished.write_text("".join(_line(row) for row in ([self._header] if self._header else []) + rows))
        self._names: list[str] = []
        self._file = self._path.open("a", newline="")

    def write(self, iteration: int, values: Mapping[str, Any]) -> None:
        """Append a row.

        Args:
          iteration: number of the iteration, written to the first column.
          values: scalars by name; every row needs the same names in the same order.

        Raises:
          ValueError: the names or their order differ from those of the first row written.
        """
        names = list(values)
        if not self._names:
            self._begin(names)
        if names != self._names:
            odd = sorted(set(names) ^ set(self._names)) or "their order"
            raise ValueError(f"row {iteration} of {self._path} differs from the first in {odd}: keep one set of names")
        cells = {"iteration": str(iteration), **{name: _text(value) for name, value in values.items()}}
        self._file.write(_line([cells.get(name, "") for name in self._header]))
        self._file.flush()
        self.last_iteration = iteration

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _begin(self, names: list[str]) -> None:
        """Write the header, or widen that of the existing file."""
        self._names, known = names, self._header or ["iteration"]
        header = known + [name for name in names if name not in known]
        if self._header and header != known:
            self._file.close()
            empty = [""] * (len(header) - len(known))
            rows = [row + empty for row in _read_rows(self._path)[1]]
            with replacing(self._path) as unfinished:
                unfinished.write_text("".join(map(_line, [header, *rows])))
            self._file = self._path.open("a", newline="")
        elif not self._header:
            self._file.write(_line(header))
        self._header = header


class TensorBoardWriter:
    """Writes scalars for TensorBoard into ``folder``. Non-finite numbers are omitted.

    Args:
      folder: folder for the event files.
      resume_at: iteration that the run continues from; TensorBoard hides values of later iterations.
    """

    def __init__(self, folder: str | Path, *, resume_at: int = 0) -> None:
        from tensorboardX import SummaryWriter  # slow to import, and only needed here
        from tensorboardX.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]

        self._writer = SummaryWriter(str(folder), purge_step=resume_at + 1 if resume_at else None)
        self._summary = Summary
        # On a full disk, the writer's thread and exit handler would print tracebacks. Writing the CSV files already
        # raises an error then.
        events = self._writer.file_writer.event_writer._ev_writer  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
        for name in ("write_event", "flush", "close"):
            setattr(events, name, _without_os_errors(getattr(events, name)))

    def write(self, iteration: int, values: Mapping[str, Any], *, prefix: str = "train") -> None:
        """Write ``<prefix>/<name>`` for every value, as one event."""
        finite = {f"{prefix}/{name}": float(value) for name, value in values.items() if math.isfinite(value)}
        numbers = [self._summary.Value(tag=tag, simple_value=value) for tag, value in finite.items()]
        if self._writer.file_writer is not None:
            self._writer.file_writer.add_summary(self._summary(value=numbers), iteration)

    def close(self) -> None:
        """Flush and close the file."""
        self._writer.close()


class WandbWriter:
    """Sends scalars to Weights & Biases, with the iteration as x-axis. Non-finite numbers are omitted.

    A resumed run continues the same page. The page's identifier is stored in the file ``wandb_id`` in ``run_dir``.

    Args:
      project: name of the project.
      run_dir: directory of the run. Its name becomes the name of the page, and ``wandb`` writes its files there.
      config: description of the run, shown on the page.

    Raises:
      ValueError: wandb is not installed.
    """

    def __init__(self, project: str, run_dir: Path, config: Mapping[str, Any]) -> None:
        need_wandb()
        import wandb  # slow to import, and only needed here  # pyright: ignore[reportMissingImports]

        path = run_dir / "wandb_id"
        if not path.is_file():
            path.write_text(f"{secrets.token_hex(4)}\n")
        self._run = wandb.init(
            project=project,
            name=run_dir.name,
            id=path.read_text().strip(),
            resume="allow",
            reinit="create_new",  # seeds side by side have a page each
            dir=str(run_dir),
            config=dict(config),
        )
        self._run.define_metric("iteration")
        self._run.define_metric("*", step_metric="iteration")

    def write(self, iteration: int, values: Mapping[str, Any], *, prefix: str = "train") -> None:
        """Send ``<prefix>/<name>`` for every value."""
        finite = {f"{prefix}/{name}": float(value) for name, value in values.items() if math.isfinite(value)}
        self._run.log({"iteration": iteration, **finite})

    def close(self) -> None:
        """Send the remaining values and end the page."""
        self._run.finish()


def _without_os_errors(function: Callable[..., Any]) -> Callable[..., None]:
    """Wrap a function so that OSErrors are ignored and nothing is returned."""

    def call(*args: Any) -> None:
        with contextlib.suppress(OSError):
            function(*args)

    return call


def need_wandb() -> None:
    """Check that wandb is installed.

    Raises:
      ValueError: wandb is not installed.
    """
    if importlib.util.find_spec("wandb") is None:
        raise ValueError("train.wandb needs Weights & Biases: pip install 'rewax[wandb]'")


def read_csv(path: str | Path) -> dict[str, np.ndarray]:
    """Columns of a CSV file by name, float64, shape (num_rows,); empty if the file is missing or has no header.

    Cells that are not numbers become NaN.
    """
    header, rows = _read_rows(Path(path))
    table = np.array([[_number(cell) for cell in row] for row in rows]).reshape(len(rows), len(header))
    return {name: table[:, i] for i, name in enumerate(header)}


def _read_rows(path: Path) -> tuple[list[str], list[list[str]]]:
    """Header and complete rows; two empty lists if the file is missing or has no header."""
    if not path.is_file():
        return [], []
    text = path.read_text(errors="replace")
    header, *rows = list(csv.reader(io.StringIO(text[: text.rfind("\n") + 1]))) or [[]]
    if header[:1] != ["iteration"]:
        return [], []
    return header, [row for row in rows if len(row) == len(header) and row[0].isdecimal()]


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _line(cells: list[str]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(cells)
    return buffer.getvalue()


def _text(value: Any) -> str:
    """The shortest text that parses to the same number in the same dtype."""
    return str(np.asarray(value)[()])
