"""Progress of a run: a bar on a terminal, lines elsewhere."""

import math
import time
from collections import Counter
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from rewax.status import Status, remedy

_SECONDS_BETWEEN_LINES = 5.0


class ProgressReport:
    """Shows return, entropy, speed and time left, and the numbers of failed episodes and dropped gradients.

    A status bit is explained once, with a remedy, when it is first set; later lines have its count of steps while that
    grows, and ``close`` prints the counts of the whole run.

    Args:
      console: to print to.
      num_iterations: total number, kept in the attribute ``total``, which may be changed.
      start: number of iterations done before this process.
    """

    def __init__(self, console: Console, num_iterations: int, start: int) -> None:
        self._console, self.total, self._start = console, num_iterations, start
        self._shown: dict[str, float] = {"return": math.nan, "entropy": math.nan}
        self._counts = {"failed_episodes": 0, "dropped_gradients": 0}
        self._status: Counter[str] = Counter()
        self._shown_status: Counter[str] = Counter()
        self._began = time.perf_counter()
        self._last_line = -math.inf
        self._bar: Progress | None = None
        self._task = TaskID(0)
        if console.is_terminal:
            columns = (TextColumn("training"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"))
            self._bar = Progress(*columns, console=console)
            self._task = self._bar.add_task("", total=num_iterations, completed=start)
            self._bar.start()

    def update(self, iteration: int, env_steps: int, metrics: Mapping[str, Any], steps_per_second: float) -> None:
        """Show an iteration. A metric that is NaN, because no episode ended, keeps its previous value."""
        for name in self._shown:
            if math.isfinite(value := float(metrics.get(name, math.nan))):
                self._shown[name] = value
        for name in self._counts:
            self._counts[name] += int(metrics.get(name, 0))
        self._count_status(iteration, metrics)
        elapsed = time.perf_counter() - self._began
        left = elapsed / (iteration - self._start) * (self.total - iteration)
        parts = [f"{name} {value:.3g}" for name, value in self._shown.items() if math.isfinite(value)]
        said = {"failed_episodes": "episodes failed", "dropped_gradients": "gradients dropped"}
        parts += [f"{count} {said[name]}" for name, count in self._counts.items() if count]
        new = {bit: count - self._shown_status[bit] for bit, count in self._status.items()}
        parts += [f"{bit} in {count} more steps" for bit, count in new.items() if count]
        text = "  ".join([*parts, f"{steps_per_second:,.0f} steps/s", f"{duration(left)} left"])
        if self._bar is not None:
            self._bar.update(self._task, total=self.total, completed=iteration, description=text)
        elif iteration == self.total or elapsed - self._last_line >= _SECONDS_BETWEEN_LINES:
            self._last_line, self._shown_status = elapsed, self._status.copy()
            say(self._console, f"iteration {iteration}/{self.total}  {env_steps:,} steps  {text}")

    def _count_status(self, iteration: int, metrics: Mapping[str, Any]) -> None:
        """Count steps by the status bits that are set in them, and explain a bit that is new."""
        for name, count in metrics.items():
            bit = name.removeprefix("status/")
            if bit == name or bit == "NAN" or not int(count):  # failed episodes are counted apart
                continue
            if not self._status[bit]:
                say(
                    self._console,
                    f"status: {bit} in {int(count)} steps of iteration {iteration}: the physics may be wrong there; "
                    f"remedy: {remedy(Status[bit])} (docs/troubleshooting.md)",
                )
                self._shown_status[bit] = int(count)
            self._status[bit] += int(count)

    def close(self) -> None:
        """Leave the terminal as it was found, and print how often each status bit was set."""
        if self._bar is not None:
            self._bar.stop()
        if self._status:
            counts = ", ".join(f"{bit} in {count} steps" for bit, count in self._status.items())
            say(self._console, f"status of all steps: {counts}")


def say(console: Console, text: str) -> None:
    """Print a line as it is: no wrapping, no markup."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def duration(seconds: float) -> str:
    """``m:ss``, or ``h:mm:ss`` from an hour on."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
