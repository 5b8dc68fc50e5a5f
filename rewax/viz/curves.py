"""Pictures that compare: learning curves of several seeds, returns around a policy."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from rewax.statistics import Curve
from rewax.viz.plots import STYLE, plain

CURVE_COLORS = ("#c44e52", "#4c72b0", "#2a7f4f", "#dd8452", "#8172b3", "#937860", "#da8bc3", "#8c8c8c", "#ccb974")
_POINTS = 80
_INSIDE = 6
"""Number of names that have room between the curves; a longer legend is beside them."""
_LEGEND_POINTS = 160.0
"""Height of all names of a legend, in points of type."""
_CUT = 2
"""Share of the lowest points that may be cut off [%]."""


def curves_of_seeds(
    runs: Mapping[str, Sequence[Curve]],
    out_png: str | Path,
    *,
    title: str = "",
    levels: Mapping[str, float] | None = None,
) -> Path:
    """Draw the mean return over seeds against environment steps, and each seed as a thin line.

    Where some seeds have ended, the mean is that of the others. A few points far below all others are cut off, and the
    picture says so.

    Args:
      runs: by name, each seed's learning curve; those without points are left out.
      out_png: picture to write.
      title: above it.
      levels: name and return of horizontal lines.

    Returns:
      The path written.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 4.0), layout="constrained")
        axes = figure.subplots()
        for (name, seeds), color in zip(runs.items(), itertools.cycle(CURVE_COLORS), strict=False):
            curves = [curve for curve in seeds if curve.steps.size]
            if not curves:
                continue
            if len(curves) > 1:
                for curve in curves:
                    axes.plot(*curve, color=color, lw=0.6, alpha=0.45)
            grid, mean = mean_curve(curves)
            axes.plot(grid, mean, color=color, lw=1.8, label=_shown(f"{name} ({len(curves)})"), zorder=3)
        for (name, value), style in zip((levels or {}).items(), itertools.cycle(("--", ":", "-.")), strict=False):
            axes.axhline(value, color="0.35", ls=style, lw=1.0, label=_shown(name))
        axes.set(title=plain(title), xlabel="environment steps", ylabel="return of training episodes")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        _cut_off_outliers(axes, [curve for seeds in runs.values() for curve in seeds], (levels or {}).values())
        if num_names := len(axes.get_legend_handles_labels()[0]):
            size = min(8.0, _LEGEND_POINTS / num_names)
            if num_names > _INSIDE:
                figure.legend(loc="outside right upper", fontsize=size, frameon=False)
            else:
                axes.legend(loc="best", fontsize=size, framealpha=0.7)
        figure.savefig(out_png)
    return Path(out_png)


def _cut_off_outliers(axes: Axes, curves: Sequence[Curve], levels: Iterable[float]) -> None:
    """Begin the axis of returns above the lowest 2 % of the points if these would take more than half of it."""
    points = np.concatenate([np.zeros(0), *(curve.returns for curve in curves)])
    points = points[np.isfinite(points)]
    if not points.size:
        return
    shown = [np.percentile(points, _CUT), points.max(), *levels]
    low, high = min(shown), max(shown)
    if low - points.min() > high - low > 0.0:
        axes.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
        axes.text(1.0, 1.0, "the lowest points are cut off", transform=axes.transAxes, ha="right", va="bottom", size=6)


def mean_curve(curves: Sequence[Curve]) -> Curve:
    """Mean of the curves that reach each step, to within an 80th of the whole range."""
    grid = np.linspace(min(c.steps[0] for c in curves), max(c.steps[-1] for c in curves), _POINTS)
    near = grid[1] - grid[0]
    within = np.stack([(c.steps[0] - near <= grid) & (grid <= c.steps[-1] + near) for c in curves])
    values = np.where(within, np.stack([c.at(grid).returns for c in curves]), 0.0)
    count = within.sum(axis=0)
    return Curve(grid, np.where(count > 0, values.sum(axis=0) / np.maximum(count, 1), np.nan))


def _shown(label: str) -> str:
    """A label that the legend shows: matplotlib hides those that begin with an underscore."""
    return plain(f"\u200b{label}" if label.startswith("_") else label)


def landscape_picture(offsets: np.ndarray, returns: np.ndarray, out_png: str | Path, *, title: str = "") -> Path:
    """Draw returns on a square of two directions; the policy is the cross in the middle.

    The colour scale begins at the tenth percentile; lower returns have one colour. Returns that are not finite have
    none.

    Args:
      offsets: along either direction, shape (size,).
      returns: shape (size, size), the first axis along the first direction.
      out_png: picture to write.
      title: above it.

    Returns:
      The path written.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.4, 4.4), layout="constrained")
        axes = figure.subplots()
        returns = np.ma.masked_invalid(np.asarray(returns, np.float64))  # float32 cannot divide a narrow scale
        levels = _levels(returns.compressed())
        filled = axes.contourf(offsets, offsets, returns.T, levels=levels, cmap="viridis", extend="min")
        lines = [level for level in levels[::2] if returns.min() < level < returns.max()]
        axes.contour(offsets, offsets, returns.T, levels=lines, colors="white", linewidths=0.3, alpha=0.6)
        axes.plot(0.0, 0.0, marker="x", color="white", ms=8, mew=2)
        axes.set(title=plain(title), xlabel="first direction", ylabel="second direction", aspect="equal")
        axes.grid(False)
        figure.colorbar(filled, ax=axes, label="return", format="%.4g")
        figure.savefig(out_png)
    return Path(out_png)


def _levels(known: np.ndarray) -> np.ndarray:
    """Steps of the colour scale for finite returns, shape (25,); a few very bad corners would hide all the rest."""
    low, high = (np.percentile(known, 10.0), known.max()) if known.size else (0.0, 1.0)
    return np.linspace(low, max(high, low + 1e-6 * max(abs(low), 1.0)), 25)
