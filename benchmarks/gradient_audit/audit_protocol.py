"""How a gradient is audited: against central differences of the same simulator's own forward function."""

import dataclasses
import resource
import time
from collections.abc import Callable

import numpy as np

STEPS = {"float64": tuple(10.0 ** -(k / 2) for k in range(6, 15)), "float32": (0.02, 0.01, 0.005)}
"""Of the central differences, in units of the parameter: the slope is taken where two neighbouring steps agree best."""
WIDE_STEP = 0.02
"""Of the slope of the landscape."""
ZERO_SLOPE = 1e-6
"""A slope below this share of the scene's largest is taken for a true zero."""


class NotSupported(Exception):
    """The simulator has no such feature; the message says which one."""


class NotTried(Exception):
    """Nobody has written this scene for this simulator; it may well be able to."""


@dataclasses.dataclass(frozen=True)
class Problem:
    """A scene in a simulator.

    Attributes:
      value: outcome at parameters of shape (num_parameters,), float64.
      gradient: of the outcome by the parameters, by the simulator's own differentiation.
      precision: "float64" or "float32", what both are computed in.
      how: which solver, law and mode of differentiation.
    """

    value: Callable[[np.ndarray], float]
    gradient: Callable[[np.ndarray], np.ndarray]
    precision: str
    how: str = ""


@dataclasses.dataclass(frozen=True)
class Row:
    """What is reported of a simulator at a scene; shares and errors are None where nothing was measured.

    Attributes:
      status: "measured", "not supported", "not tried", "not installed" or "failed".
      zeros: share of the entries that are exactly 0 or missing though the slope is not.
      nans: share of the entries that are not finite.
      error: median over the starts of |gradient - slope| / |slope|; infinite where an entry is not finite.
      worst: its largest value.
      difference_error: median uncertainty of the slope itself: how much two neighbouring steps disagree.
      wide_error: as ``error``, against the difference over ``WIDE_STEP``: the slope of the landscape.
      seconds: of one gradient, after the first.
      memory_mb: peak of the process during it.
      base_mb: of the process once the simulator was imported.
    """

    simulator: str
    scene: str
    status: str
    version: str = ""
    how: str = ""
    precision: str = ""
    entries: int = 0
    zeros: float | None = None
    nans: float | None = None
    error: float | None = None
    worst: float | None = None
    difference_error: float | None = None
    wide_error: float | None = None
    seconds: float | None = None
    memory_mb: float | None = None
    base_mb: float | None = None
    note: str = ""


def difference(value: Callable[[np.ndarray], float], at: np.ndarray, axis: int, step: float, precision: str) -> float:
    """Central difference; in float32 that of fourth order, whose steps may be longer."""

    def half(length: float) -> float:
        shift = np.zeros_like(at)
        shift[axis] = length
        return (value(at + shift) - value(at - shift)) / (2 * length)

    return half(step) if precision == "float64" else (4 * half(step) - half(2 * step)) / 3


def slope(value: Callable[[np.ndarray], float], at: np.ndarray, precision: str) -> tuple[np.ndarray, np.ndarray]:
    """Slope of the function and how much the two steps that agree best disagree, both of shape (num_parameters,)."""
    found, unsure = np.zeros(len(at)), np.zeros(len(at))
    for axis in range(len(at)):
        tried = np.array([difference(value, at, axis, step, precision) for step in STEPS[precision]])
        gaps = np.abs(np.diff(tried))
        best = int(np.argmin(np.where(np.isfinite(gaps), gaps, np.inf)))
        found[axis], unsure[axis] = 0.5 * (tried[best] + tried[best + 1]), gaps[best]
    return found, unsure


def peak_memory_mb() -> float:
    """Peak of this process since ``reset_peak``, or since it began where the kernel does not tell."""
    try:
        with open("/proc/self/status") as file:
            return next(float(line.split()[1]) / 1024 for line in file if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def reset_peak() -> None:
    try:
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")
    except OSError:
        pass


def compare(gradients: np.ndarray, slopes: np.ndarray) -> dict[str, float | None]:
    """Shares and errors of gradients against slopes, both of shape (num_starts, num_parameters)."""
    moving = np.abs(slopes) > ZERO_SLOPE * np.max(np.abs(slopes), initial=0.0)
    finite = np.isfinite(gradients)
    norms = np.maximum(np.linalg.norm(slopes, axis=1), 1e-300)
    with np.errstate(invalid="ignore"):
        errors = np.linalg.norm(gradients - slopes, axis=1) / norms
    errors = np.where(np.isfinite(errors), errors, np.inf)
    return {
        "zeros": float(np.mean((gradients == 0) & moving)),
        "nans": float(np.mean(~finite)),
        "error": float(np.median(errors)),
        "worst": float(np.max(errors)),
    }


def audit(problem: Problem, starts: np.ndarray, *, repeats: int = 3, wide: bool = True) -> dict:
    """Numbers of ``Row`` for a problem at starts of shape (num_starts, num_parameters)."""
    problem.gradient(starts[0])  # compiles
    reset_peak()
    begin = time.perf_counter()
    for i in range(repeats):
        problem.gradient(starts[i % len(starts)])
    seconds = (time.perf_counter() - begin) / repeats
    memory = peak_memory_mb()
    gradients = np.array([problem.gradient(start) for start in starts], dtype=np.float64)
    found = [slope(problem.value, start, problem.precision) for start in starts]
    slopes, unsure = (np.array(part) for part in zip(*found, strict=True))
    numbers = compare(gradients, slopes)
    numbers["difference_error"] = float(np.median(np.linalg.norm(unsure, axis=1) / np.linalg.norm(slopes, axis=1)))
    if wide:
        axes = range(starts.shape[1])
        landscape = [[difference(problem.value, s, a, WIDE_STEP, "float64") for a in axes] for s in starts]
        numbers["wide_error"] = compare(gradients, np.array(landscape))["error"]
    return {**numbers, "entries": gradients.size, "seconds": seconds, "memory_mb": memory}
