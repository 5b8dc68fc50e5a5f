"""A column of water collapses: its front on the floor against Martin and Moyce (1952).

Their column twice as high as its width a (n^2 = 2): Z = front / a over T = t sqrt(2 g / a). Tait's law, frictionless
walls, plane strain. A dam takes time to go, which delays the experiment: the front is compared as it is, and with a
clock shifted by the one number that fits best. Other runs of the experiment lie up to 2.8 % (theirs) and 10 %
(Koshizuka and Oka 1996) from the table.
"""

import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import Check, fill, foremost, held, record, relative, save
from rewax.physics import mpm
from rewax.physics.mpm import Grid, Material, Tait, Wall, Walls
from rewax.status import Status, describe

TABLE = np.array([
    (0.41, 1.11), (0.84, 1.22), (1.19, 1.44), (1.43, 1.67), (1.63, 1.89), (1.83, 2.11), (1.98, 2.33), (2.20, 2.56),
    (2.32, 2.78), (2.51, 3.00), (2.65, 3.22), (2.83, 3.44), (2.98, 3.67), (3.11, 3.89), (3.33, 4.11),
])  # fmt: skip
"""(T, Z) of their table 2: n^2 = 2, a = 2.25 in."""
OTHERS = {
    "a = 1.125 in, figure 3": np.array(
        [(0.849, 1.245), (1.212, 1.443), (1.602, 1.884), (2.283, 2.689), (2.950, 3.728)]
    ),
    "a = 2.25 in, figure 3": np.array([(0.832, 1.217), (1.219, 1.474), (1.997, 2.292), (2.547, 2.995), (3.345, 4.134)]),
    "Koshizuka & Oka 1996": np.array(
        [
            (0.381, 1.111),
            (0.769, 1.252),
            (1.153, 1.505),
            (1.537, 1.892),
            (1.935, 2.241),
            (2.323, 2.615),
            (2.719, 3.003),
            (3.096, 3.624),
        ]
    ),
}
"""(T, Z) of n^2 = 2, read off figures: how far other runs of the experiment scatter around the table."""
FROM = 0.8
"""Before this T the dam still counts: the experiment starts early and slowly, whatever the clock's origin."""
CELLS = {"tiny": 8, "small": 16, "full": 40}
"""Over the width a."""
WIDTH, GRAVITY, DENSITY, LAST = 0.05715, 9.81, 1000.0, 3.4
SPEED = 12.0 * float(np.sqrt(2 * GRAVITY * WIDTH))
"""Speed of sound [m/s]: twelve times sqrt(g height)."""
EVERY = 10
BARS = {"tiny": 0.08, "small": 0.05, "full": 0.05}


def column(cells: int) -> tuple[mpm.MPMScene, mpm.MPMState]:
    spacing = WIDTH / cells
    x = jnp.asarray(fill((0.0, 0.0), (WIDTH, 2 * WIDTH), spacing), jnp.float32)
    wall = Wall(position=0.5 * spacing)
    shape = (5 * cells + 6, 2 * cells + 8, 4)
    scene = mpm.make_scene(
        grid=Grid(shape=shape, spacing=spacing, origin=(-2 * spacing, -2 * spacing, -spacing)),
        dt=0.3 * spacing / SPEED, particle_volume=(spacing / 2) ** 3, gravity=(0.0, -GRAVITY, 0.0),
        material=Material(density=DENSITY, elasticity=Tait(speed_of_sound=SPEED)),
        walls=Walls(lower=(wall, wall, held(spacing)), upper=(None, None, held(spacing))),
        max_active_nodes=4 * 4 * (cells + 8) * (2 * cells + 8),
    )  # fmt: skip
    return scene, mpm.initial_state(x)


def observe(scene: mpm.MPMScene, state: mpm.MPMState) -> Any:
    """The front: the foremost particle's, and half its width."""
    return foremost(state) + scene.grid.spacing / 4


def shift_that_fits(T: np.ndarray, Z: np.ndarray) -> float:
    """By how much later the experiment's clock should start: least squares in Z over the table."""
    shifts = np.linspace(-0.5, 0.5, 201)
    misfit = [np.sum((np.interp(TABLE[:, 0] - s, T, Z) - TABLE[:, 1]) ** 2) for s in shifts]
    return float(shifts[int(np.argmin(misfit))])


def run(scale: str = "small") -> dict[str, Any]:
    """Front over time, and its distance from the table."""
    scene, start = column(CELLS[scale])
    unit = float(np.sqrt(WIDTH / (2 * GRAVITY)))
    num_samples = round(LAST * unit / (scene.dt * EVERY))
    end, seen = record(scene, start, every=EVERY, num_samples=num_samples, observe=observe)
    status = int(mpm.check_status(scene, end, start=end))
    if status & ~Status.OUT_OF_DOMAIN:
        raise RuntimeError(f"the simulation failed: status {describe(status)}")
    T = np.concatenate([[0.0], scene.dt * EVERY * np.arange(1, num_samples + 1) / unit])
    Z = np.concatenate([[1.0], np.asarray(seen) / WIDTH])
    shift = shift_that_fits(T, Z)
    as_it_is = np.interp(TABLE[:, 0], T, Z) / TABLE[:, 1] - 1
    shifted = np.interp(TABLE[:, 0] - shift, T, Z) / TABLE[:, 1] - 1
    late = T + shift > 1.9
    speed = np.polyfit(T[late], Z[late], 1)[0]
    theirs = np.polyfit(*TABLE[TABLE[:, 0] > 1.9].T, 1)[0]
    compared = TABLE[:, 0] > FROM

    def check(what: str, off: np.ndarray, bar: float) -> Check:
        k = int(np.argmax(np.abs(off) * compared))
        return Check(what=f"front at T = {TABLE[k, 0]:g}, {what}", measured=float((1 + off[k]) * TABLE[k, 1]),
                     theory=float(TABLE[k, 1]), unit="a", error=float(np.abs(off[k])), bar=bar)  # fmt: skip

    checks = [
        check(f"worst, clock shifted by {shift:.2f}", shifted, BARS[scale]),
        check("worst, clock as it is (for the record)", as_it_is, math.inf),
        relative("late speed of the front", speed, theirs, 2 * BARS[scale], "dZ/dT"),
    ]
    return {"checks": checks, "T": T, "Z": Z, "shift": shift, "x": np.asarray(end.x) / WIDTH, "cells": CELLS[scale]}


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4))
    T, Z, shift = results["T"], results["Z"], results["shift"]
    left.plot(T + shift, Z, "C0-", label=f"simulation, clock shifted by {shift:.2f}")
    left.plot(T, Z, "C0:", label="simulation")
    left.plot(*TABLE.T, "ko", ms=4, label="Martin & Moyce, table 2")
    for (name, points), mark in zip(OTHERS.items(), "^sv", strict=True):
        left.plot(*points.T, "k" + mark, ms=4, mfc="none", label=name)
    left.set(xlabel="T = t sqrt(2 g / a) [-]", ylabel="front / a [-]", xlim=(0, LAST), ylim=(0.9, 4.6))
    left.legend(frameon=False, fontsize=7)
    right.plot(*results["x"][:, :2].T, ".", ms=1)
    right.set(xlabel="x / a [-]", ylabel="y / a [-]", aspect="equal", title=f"T = {T[-1]:.1f}")
    save(figure, path)
