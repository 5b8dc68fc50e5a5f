"""Pictures of a fit over time: what was seen, beside the simulation with the seen points over it."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from rewax.identify.picture import simulated
from rewax.identify.records import Record
from rewax.identify.result import Identified

_SEEN, _SIMULATED = "#1f5fa8", "#c9b08a"
_ELEVATION = np.deg2rad(25.0)


def film(result: Identified, record: Record, *, size: tuple[int, int] = (420, 960)) -> Iterator[np.ndarray]:
    """Pictures of all frames, uint8, shape (height, width, 3) each.

    Args:
      result: of ``identify``; its values are simulated.
      record: that was fitted, or another one of the same scene. Titles have the residuals of the fit if the times are
        those of the fitted one.
      size: height and width in pixels.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height, width = size
    particles = simulated(result, record)
    view = _view(record, np.asarray(getattr(result.env, "up", (0.0, 1.0, 0.0))))
    low, high = _range(np.concatenate([particles.reshape(-1, 3), record.clouds[record.mask]]) @ view.T)
    fitted = np.array_equal(record.times, result.times)
    for n in range(record.num_frames):
        figure = Figure(figsize=(width / 100, height / 100), dpi=100, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        seen, body = record.clouds[n][record.mask[n]] @ view.T, particles[n] @ view.T
        body = body[np.argsort(body[:, 2])]  # far ones first
        left, right = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, title in ((left, "seen"), (right, "simulated, and seen over it")):
            axes.set(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]), title=title, xticks=[], yticks=[])
        shade = 0.35 + 0.65 * (body[:, 2] - low[2]) / (high[2] - low[2])
        right.scatter(*body[:, :2].T, s=30, color=_SIMULATED, alpha=np.clip(shade, 0.0, 1.0), linewidths=0)
        for axes in (left, right):
            axes.scatter(*seen[:, :2].T, s=8, color=_SEEN, linewidths=0)
        residual = f", residual {1e3 * result.residual_by_frame[n]:.1f} mm" if fitted else ""
        figure.suptitle(f"{record.times[n]:.3f} s{residual}", fontsize=9)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _view(record: Record, up: np.ndarray) -> np.ndarray:
    """Axes to the right, upwards and towards the camera, rows of shape (3, 3)."""
    towards = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    if record.camera is not None:
        towards = record.camera[:3] - record.clouds[record.mask].mean(0)
    towards = towards - up * (towards @ up)
    towards = towards / np.linalg.norm(towards)
    towards = np.cos(_ELEVATION) * towards + np.sin(_ELEVATION) * up
    right = np.cross(up, towards)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def _range(points: Any) -> tuple[np.ndarray, np.ndarray]:
    low, high = points.min(0), points.max(0)
    margin = 0.05 * (high - low).max()
    return low - margin, high + margin


__all__ = ["film"]
