"""Pictures of rigid bodies in motion."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from rewax.viz.plots import STYLE, plain
from rewax.viz.shapes import Drawing, View, check_drawing, outline, side_view

_NEAR, _FAR = np.array([0.22, 0.42, 0.65]), np.array([0.75, 0.82, 0.90])
_SPACING, _MARK = 0.5, 0.06
"""Distance of marks on the ground, and their length [m]."""


def body_strip(
    frames: Sequence[Sequence[Drawing]],
    out_png: str | Path,
    *,
    labels: Sequence[str] = (),
    up: Sequence[float] | np.ndarray = (0.0, 1.0, 0.0),
    title: str = "",
) -> Path:
    """Draw rigid shapes over time: a panel for each frame, seen from the side, that follows the shapes sideways.

    Args:
      frames: drawings of each frame (``rewax.viz.shapes``), at least one of them not a plane.
      out_png: picture to write.
      labels: one for each frame, e.g. its time.
      up: unit vector that points up in the picture, shape (3,).
      title: of the picture.

    Returns:
      The path written. Nearer shapes are darker. All panels have one scale. Marks on the ground are 0.5 m apart.

    Raises:
      ValueError: kind or keys of a drawing are wrong, or a frame has nothing but planes.
    """
    view = side_view(up)
    lows, highs = (np.stack(corners) for corners in zip(*(_extent(shapes, view) for shapes in frames), strict=True))
    middle = 0.5 * (lows[:, 0] + highs[:, 0])
    floors = [floor for shapes in frames for floor in _floors(shapes, view)]
    low, high = min([lows[:, 1].min(), *floors]), highs[:, 1].max()
    margin = 0.08 * max(high - low, (highs - lows)[:, 0].max())
    half_width = 0.5 * (highs - lows)[:, 0].max() + margin
    low, high = low - margin, high + margin
    scale = min(11.0 / (2.0 * half_width * len(frames)), 3.2 / (high - low))
    size = (scale * 2.0 * half_width * len(frames) + 0.9, scale * (high - low) + 0.9)
    with mpl.rc_context({**STYLE, "axes.grid": False, "font.size": 8}):
        figure = Figure(figsize=size, layout="constrained")
        panels = figure.subplots(1, len(frames), squeeze=False, sharey=True)[0]
        for i, (axes, shapes) in enumerate(zip(panels, frames, strict=True)):
            axes.set(xlim=(middle[i] - half_width, middle[i] + half_width), ylim=(low, high), aspect="equal")
            axes.locator_params(axis="x", nbins=4 if scale * half_width > 0.75 else 2)
            _draw(axes, shapes, view, np.array([middle[i], 0.5 * (low + high)]), half_width + high - low)
            axes.set_xlabel(f"{_name(view.right)} [m]")
            if i < len(labels):
                axes.set_title(plain(labels[i]), fontsize=8)
        panels[0].set_ylabel(f"{_name(view.up)} [m]")
        if title:
            figure.suptitle(plain(title), fontsize=10)
        figure.savefig(out_png)
    return Path(out_png)


def _draw(axes: Axes, shapes: Sequence[Drawing], view: View, middle: np.ndarray, reach: float) -> None:
    """One panel: first the planes seen edge on, then the other shapes from far (light) to near (dark)."""
    for shape in shapes:
        if shape["kind"] == "plane":
            _draw_plane(axes, shape, view, middle, reach)
    solid = [shape for shape in shapes if shape["kind"] != "plane"]
    depth = np.array([np.asarray(shape["center"], float) @ view.towards for shape in solid])
    nearness = (depth - depth.min()) / max(float(np.ptp(depth)), 1e-9) if np.ptp(depth) > 1e-6 else np.ones(len(depth))
    for i in np.argsort(depth, kind="stable"):
        color = _FAR + nearness[i] * (_NEAR - _FAR)
        axes.add_patch(
            Polygon(outline(solid[i], view), closed=True, facecolor=color, edgecolor="0.15", lw=0.6, zorder=2)
        )


def _draw_plane(axes: Axes, plane: Drawing, view: View, middle: np.ndarray, reach: float) -> None:
    """The ground under a plane, up to ``reach`` from the panel's middle. A plane that faces the eye is not drawn."""
    normal = view.project(_unit(plane["direction"]))
    if np.linalg.norm(normal) < 0.99:
        return
    normal = normal / np.linalg.norm(normal)
    along = np.array([normal[1], -normal[0]])
    start = view.project(np.asarray(plane["center"], float))
    foot = start + along * ((middle - start) @ along)
    corners = [foot - reach * along, foot + reach * along]
    ground = [*corners, corners[1] - reach * normal, corners[0] - reach * normal]
    axes.add_patch(Polygon(np.stack(ground), closed=True, facecolor="0.93", edgecolor="none", zorder=0))
    axes.plot(*np.stack(corners).T, color="0.35", lw=1.0, zorder=1)
    first = float(np.ceil(((foot - start) @ along - reach) / _SPACING)) * _SPACING
    for place in np.arange(first, first + 2.0 * reach, _SPACING):
        top = start + place * along
        axes.plot(*np.stack([top, top - _MARK * normal]).T, color="0.35", lw=0.8, zorder=1)


def _extent(shapes: Sequence[Drawing], view: View) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right corner of a frame's shapes in the picture, shape (2,) each."""
    for shape in shapes:
        check_drawing(shape)
    corners = [outline(shape, view) for shape in shapes if shape["kind"] != "plane"]
    if not corners:
        raise ValueError("a frame has no shape other than planes: there is nothing to follow")
    points = np.concatenate(corners)
    return points.min(axis=0), points.max(axis=0)


def _floors(shapes: Sequence[Drawing], view: View) -> list[float]:
    """Heights of level planes in the picture."""
    planes = [shape for shape in shapes if shape["kind"] == "plane" and _unit(shape["direction"]) @ view.up > 0.99]
    return [float(np.asarray(plane["center"], float) @ view.up) for plane in planes]


def _unit(vector: np.ndarray) -> np.ndarray:
    vector = np.asarray(vector, float)
    return vector / np.linalg.norm(vector)


def _name(direction: np.ndarray) -> str:
    """Name of an axis of the world, or nothing for another direction."""
    axis = int(np.argmax(np.abs(direction)))
    return "xyz"[axis] if direction[axis] > 0.99 else ""


__all__ = ["body_strip"]
