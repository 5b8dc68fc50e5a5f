"""A picture of a fit: the cloud over the simulation at four times, the residual by frame, the parameters with bands."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.identify.records import Record
from rewax.identify.result import Identified
from rewax.identify.simulate import data_of, simulated_frames, without_reset_noise
from rewax.identify.uncertainty import short
from rewax.whole_files import replacing


def draw(result: Identified, record: Record, path: str | Path) -> Path:
    """Write a picture; returns its path."""
    from matplotlib.figure import Figure

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(13.0, 6.5), layout="constrained")
    grid = figure.add_gridspec(2, 4)
    frames = simulated(result, record)
    shown = np.linspace(0, record.num_frames - 1, 4).round().astype(int)
    across, up = _axes(result, record)
    for column, n in enumerate(shown):
        axes: Any = figure.add_subplot(grid[0, column])
        seen = record.clouds[n][record.mask[n]]
        axes.scatter(frames[n, :, across], frames[n, :, up], s=6, color="#c9b08a", label="simulated")
        axes.scatter(seen[:, across], seen[:, up], s=3, color="#1f5fa8", label="seen")
        axes.set(
            aspect="equal", title=f"{record.times[n]:.3g} s", xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[up]} [m]"
        )
        if column == 0:
            axes.legend(loc="lower left", fontsize=7)
    axes = figure.add_subplot(grid[1, 0:2])
    axes.plot(result.times, 1e3 * result.residual_by_frame, marker="o", color="#1f5fa8")
    axes.set(xlabel="time [s]", ylabel="residual [mm]", ylim=(0.0, None), title="distance of seen points, by frame")
    axes = figure.add_subplot(grid[1, 2:4])
    _draw_parameters(axes, result)
    with replacing(path) as unfinished:
        figure.savefig(unfinished, dpi=110)
    return path


def _draw_parameters(axes: Any, result: Identified) -> None:
    """The way of each unknown, in standard deviations of its prior, and its 95 % interval."""
    for i, label in enumerate(result.space.labels):
        way = np.array([result.space.latent(row)[i] for row in result.history])
        (line,) = axes.plot(np.arange(1, len(way) + 1), way, label=short(label))
        reach = 1.96 * float(np.sqrt(result.covariance[i, i]))
        axes.axhspan(result.latent[i] - reach, result.latent[i] + reach, color=line.get_color(), alpha=0.15)
    axes.set(xlabel="iteration", ylabel="standard deviations of the prior", title="unknowns, with 95 % intervals")
    axes.legend(fontsize=8)


def simulated(result: Identified, record: Record) -> np.ndarray:
    """Particles at the times of a record, with the values found [m], shape (num_frames, num_particles, 3)."""
    latent = jnp.asarray(result.latent, jnp.float32)
    env = without_reset_noise(result.env)
    simulate = jax.jit(lambda z: simulated_frames(env, result.space, z, data_of(record, 1.0, 1))[0])
    return np.asarray(simulate(latent))


def _axes(result: Identified, record: Record) -> tuple[int, int]:
    """The horizontal axis along which the cloud is longest, and the vertical one."""
    up = int(np.argmax(np.abs(np.asarray(getattr(result.env, "up", (0.0, 1.0, 0.0))))))
    extent = np.ptp(record.clouds[record.mask], axis=0)
    extent[up] = -1.0
    return int(np.argmax(extent)), up


__all__ = ["draw", "simulated"]
