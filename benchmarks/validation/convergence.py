"""Order of convergence for a smooth elastic problem: a standing pressure wave in a laterally confined bar.

The bar of ``wave_speed`` with free ends; after 0.35 periods the displacement of every particle is compared with the
exact (A / omega) sin(omega t) cos(pi x / L) in the root mean square, while cells and substeps are halved together.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import Check, in_float64, record, save
from benchmarks.validation.wave_speed import LENGTH, MATERIAL, STRAIN, free_bar
from rewax.physics import mpm
from rewax.physics.mpm import sound_speed

CELLS = {"tiny": (8, 16), "small": (8, 16, 32), "full": (8, 16, 32, 64, 128, 256)}
TIME = 0.35
"""In periods."""


def displacement_error(cells: int) -> float:
    """Relative to the largest displacement."""
    c = float(sound_speed(MATERIAL))
    num_substeps = 4 * cells
    dt = TIME * 2 * LENGTH / c / num_substeps
    scene, start = free_bar(cells, None, dt)
    end, _ = record(scene, start, every=num_substeps, num_samples=1, observe=_nothing)
    X = np.asarray(start.x[:, 0])
    exact = STRAIN * LENGTH / np.pi * np.sin(2 * np.pi * TIME) * np.cos(np.pi * X / LENGTH)
    error = np.asarray(end.x[:, 0]) - X - exact
    return float(np.sqrt(np.mean(error**2)) / np.max(np.abs(exact)))


def _nothing(scene: mpm.MPMScene, state: mpm.MPMState) -> Any:
    return jnp.zeros(())


@in_float64
def run(scale: str = "small") -> dict[str, Any]:
    """Errors and the order between the two finest grids."""
    cells = np.array(CELLS[scale])
    errors = np.array([displacement_error(int(n)) for n in cells])
    orders = np.log(errors[:-1] / errors[1:]) / np.log(cells[1:] / cells[:-1])
    order = float(orders[-1])
    checks = [
        Check(what=f"order of convergence, {cells[-2]} to {cells[-1]} cells", measured=order, theory=2.0,
              error=max(2.0 - order, 0.0), bar=0.3, error_unit="below"),
    ]  # fmt: skip
    return {"checks": checks, "cells": cells, "errors": errors, "orders": orders}


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, panel = plt.subplots(figsize=(4.5, 3.4))
    cells, errors = results["cells"], results["errors"]
    panel.loglog(cells, errors, "o-", label=f"simulation, order {results['orders'][-1]:.2f} at the end")
    for order, style in ((1, ":"), (2, "--")):
        panel.loglog(cells, errors[0] * (cells[0] / cells) ** order, "k" + style, lw=1, label=f"order {order}")
    panel.set(xlabel="cells along the bar [-]", ylabel="r.m.s. error of displacement [-]")
    panel.legend(frameon=False, fontsize=8)
    save(figure, path)
