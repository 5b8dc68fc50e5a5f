"""Pictures of a run: its learning curve, and moments of an episode."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import EngFormatter

from rewax.viz.shapes import Drawing, View, bounds, check_cloud, check_drawing, outline, side_view, turned

Columns: TypeAlias = Mapping[str, np.ndarray]
"""Columns of a table by name, as ``rewax.training.storage.metrics.read_csv`` reads them."""

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "legend.frameon": True,
    "legend.framealpha": 0.85,
    "legend.edgecolor": "none",
    "figure.dpi": 150,
}
_GLASS = (0.55, 0.55, 0.6, 0.35)
_TRAINING, _SAMPLED, _DETERMINISTIC = "#4c72b0", "#dd8452", "#2a7f4f"


def learning_curve(
    metrics: Columns,
    out_png: str | Path,
    *,
    evaluation: Columns | None = None,
    baselines: Mapping[str, float] | None = None,
) -> Path:
    """Draw the return over environment steps, and below it entropy and temperature.

    Args:
      metrics: columns ``env_steps`` and, where there are, ``return``, ``entropy``, ``alpha`` or ``temperature``, each
        of shape (num_rows,).
      out_png: picture to write.
      evaluation: columns ``env_steps`` and mean and std of either kind: ``sampled_mean``, ``deterministic_mean``, ...
      baselines: name and return of horizontal lines.

    Returns:
      The path written.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 5.4), layout="constrained")
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2.6, 1))
        _draw_returns(top, metrics, evaluation or {}, baselines or {})
        _draw_exploration(bottom, metrics)
        bottom.set_xlabel("environment steps")
        bottom.xaxis.set_major_formatter(EngFormatter(sep=""))
        figure.align_ylabels()
        figure.savefig(out_png)
    return Path(out_png)


def _draw_returns(axes: Axes, metrics: Columns, evaluation: Columns, baselines: Mapping[str, float]) -> None:
    if "return" in metrics:
        ended = np.isfinite(metrics["return"])
        steps, returns = metrics["env_steps"][ended], metrics["return"][ended]
        noisy = len(returns) > 60
        axes.plot(steps, returns, color=_TRAINING, lw=0.8, alpha=0.35 if noisy else 1.0, label="training episodes")
        if noisy:
            axes.plot(steps, _running_mean(returns, len(returns) // 30), color=_TRAINING, lw=1.6, label="their mean")
    for name, color, marker in (("sampled", _SAMPLED, "o"), ("deterministic", _DETERMINISTIC, "D")):
        if f"{name}_mean" in evaluation:
            spread = np.nan_to_num(evaluation[f"{name}_std"])
            axes.errorbar(
                evaluation["env_steps"],
                evaluation[f"{name}_mean"],
                spread,
                color=color,
                marker=marker,
                ms=4,
                lw=1.2,
                elinewidth=0.8,
                capsize=2,
                label=f"evaluation, {name}",
            )
    for (name, value), style in zip(baselines.items(), ("--", ":", "-.", (0, (6, 2, 1, 2))) * 8, strict=False):
        axes.axhline(value, color="0.35", ls=style, lw=1.0, label=plain(f"{name} ({value:.3g})"))
    axes.set_ylabel("return")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="best", fontsize=8)


def _draw_exploration(axes: Axes, metrics: Columns) -> None:
    axes.set_ylabel("entropy", color=_TRAINING)
    if "entropy" in metrics:
        axes.plot(metrics["env_steps"], metrics["entropy"], color=_TRAINING, lw=1.2)
    temperature = metrics.get("alpha", metrics.get("temperature"))
    if temperature is not None:
        twin = axes.twinx()
        twin.spines["right"].set_visible(True)
        twin.grid(False)
        twin.plot(metrics["env_steps"], temperature, color=_SAMPLED, lw=1.2)
        twin.set_ylabel("temperature alpha", color=_SAMPLED)


def plain(text: str) -> str:
    """Text that matplotlib shows as it is; between two dollar signs it would read mathematics."""
    return text.replace("$", r"\$")


def _running_mean(values: np.ndarray, width: int) -> np.ndarray:
    """Mean over a centered window of ``width``, narrower towards the ends."""
    sums, reach = np.concatenate([[0.0], np.cumsum(values)]), max(width // 2, 1)
    middle = np.arange(len(values))
    low, high = np.maximum(middle - reach, 0), np.minimum(middle + reach + 1, len(values))
    return (sums[high] - sums[low]) / (high - low)


def particle_strip(
    frames: Sequence[Any],
    out_png: str | Path,
    *,
    labels: Sequence[str] = (),
    shapes: Sequence[Sequence[Drawing]] = (),
    diameter: float | None = None,
    up: Sequence[float] | np.ndarray = (0.0, 1.0, 0.0),
    title: str = "",
) -> Path:
    """Draw a particle cloud over time: a column for each frame, seen from the side and from the top.

    Args:
      frames: particle positions [m] of each frame, shape (num_particles, 3).
      out_png: picture to write.
      labels: one for each frame, e.g. its time.
      shapes: drawings of each frame (``rewax.viz.shapes``); planes are left out.
      diameter: of a drawn particle [m]; by default one that fills the first frame's volume.
      up: unit vector that points up in the side view, shape (3,).
      title: of the picture.

    Returns:
      The path written. Colour is the height; all panels have one scale.

    Raises:
      ValueError: particles have another shape, or kind or keys of a drawing are wrong.
    """
    view = side_view(up)
    axes_of_view = np.stack([view.right, view.up, view.towards])
    right, above, towards = map(_axis_name, axes_of_view)
    clouds = [check_cloud(frame) @ axes_of_view.T for frame in frames]
    for shape in (shape for frame in shapes for shape in frame):
        check_drawing(shape)
    drawn_shapes = [[turned(shape, axes_of_view) for shape in frame] for frame in shapes] or [[] for _ in clouds]
    low, high = _bounds(clouds, drawn_shapes)
    diameter = _spacing(clouds[0]) if diameter is None else diameter
    normalize = Normalize(min(c[:, 1].min() for c in clouds), max(c[:, 1].max() for c in clouds))
    extent = high - low
    width = 11.0 if len(clouds) > 3 else 3.2 * len(clouds)
    scale = width / (len(clouds) * extent[0])
    size = (width + 1.2, scale * (extent[1] + extent[2]) + 0.9)
    with mpl.rc_context({**STYLE, "axes.grid": False, "font.size": 8}):
        figure = Figure(figsize=size, layout="constrained")
        panels = figure.subplots(
            2, len(clouds), squeeze=False, sharex=True, sharey="row", height_ratios=(extent[1], extent[2])
        )
        for i, (cloud, frame_shapes) in enumerate(zip(clouds, drawn_shapes, strict=True)):
            for row, axis in enumerate((1, 2)):
                drawn = _draw_cloud(panels[row, i], cloud, frame_shapes, axis, diameter, normalize)
                # From above, what is near in the side view is at the bottom.
                ends = (low[axis], high[axis]) if axis == 1 else (high[axis], low[axis])
                panels[row, i].set(xlim=(low[0], high[0]), ylim=ends, aspect="equal")
            if i < len(labels):
                panels[0, i].set_title(plain(labels[i]), fontsize=8)
            panels[1, i].set_xlabel(f"{right} [m]")
        panels[0, 0].set_ylabel(f"side: {above} [m]")
        panels[1, 0].set_ylabel(f"top: {towards} [m]")
        figure.colorbar(drawn, ax=panels, label=f"height {above} [m]", fraction=0.03, pad=0.01, aspect=30)  # pyright: ignore[reportPossiblyUnboundVariable]
        if title:
            figure.suptitle(plain(title), fontsize=10)
        figure.savefig(out_png)
    return Path(out_png)


def _axis_name(direction: np.ndarray) -> str:
    """The name of a coordinate axis, with a minus sign for the opposite direction; empty for another direction."""
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        for sign in ("", "-"):
            if np.allclose(direction, -axis if sign else axis, atol=1e-6):
                return sign + name
    return ""


def _draw_cloud(
    axes: Axes, cloud: np.ndarray, shapes: Sequence[Drawing], up: int, diameter: float, normalize: Normalize
) -> EllipseCollection:
    """One panel: axis 0 is level, axis ``up`` is upright, nearer particles are drawn later.

    Args:
      cloud: particles along right, up and towards the eye of the side view [m], shape (num_particles, 3).
      up: 1 for the side view, 2 for the view from above.
    """
    depth = np.argsort(cloud[:, 3 - up])
    cloud = cloud[depth]
    sizes = np.full(len(cloud), diameter)
    particles = EllipseCollection(
        sizes, sizes, 0 * sizes, units="xy", offsets=cloud[:, [0, up]], offset_transform=axes.transData, lw=0
    )
    particles.set(array=cloud[:, 1], cmap="viridis", norm=normalize)
    axes.add_collection(particles)
    view = View(np.eye(3)[0], np.eye(3)[up])
    for shape in shapes:
        if shape["kind"] != "plane":
            axes.add_patch(Polygon(outline(shape, view), closed=True, facecolor=_GLASS, edgecolor="0.25", lw=1.0))
    return particles


def _bounds(clouds: Sequence[np.ndarray], shapes: Sequence[Sequence[Drawing]]) -> tuple[np.ndarray, np.ndarray]:
    """Bounding box of everything in the panels, with a margin."""
    points, drawn = np.concatenate(clouds), bounds([shape for frame in shapes for shape in frame])
    low, high = np.minimum(points.min(axis=0), drawn[0]), np.maximum(points.max(axis=0), drawn[1])
    margin = 0.04 * (high - low).max() + 1e-9
    return low - margin, high + margin


def _spacing(cloud: np.ndarray) -> float:
    """Edge of the cube that each particle occupies if all of them fill their bounding box evenly."""
    extent = np.maximum(np.ptp(cloud, axis=0), 1e-3)
    return float((np.prod(extent) / len(cloud)) ** (1 / 3))
