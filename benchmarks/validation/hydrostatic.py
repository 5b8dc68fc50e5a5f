"""Water comes to rest in a tank: its pressure is rho g (H - y).

Tait's law in plane strain; the water starts without pressure, its weight compresses it, damping stops the motion. The
sound speed of 20 sqrt(g H) makes it give way by a quarter of a percent at the bottom.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import Check, fill, held, in_float64, record, save
from rewax.physics import mpm
from rewax.physics.mpm import Grid, Material, Tait, Wall, Walls
from rewax.physics.numerics import components as cp

CELLS = {"tiny": 12, "small": 20, "full": 40}
"""Over the depth of the water."""
DEPTH, WIDTH, GRAVITY, DENSITY = 1.0, 0.5, 9.81, 1000.0
SPEED = 20.0 * float(np.sqrt(GRAVITY * DEPTH))
RADIANS = 20.0
"""Duration times the angular frequency of the first vertical swing."""
EVERY = 10


def tank(cells: int) -> tuple[mpm.MPMScene, mpm.MPMState]:
    spacing = DEPTH / cells
    x = fill((0.0, 0.0), (WIDTH, DEPTH), spacing)
    low, high = Wall(position=0.5 * spacing), Wall(position=WIDTH - 0.5 * spacing)
    scene = mpm.make_scene(
        grid=Grid(shape=(cells // 2 + 5, cells + 6, 4), spacing=spacing, origin=(-2 * spacing, -2 * spacing, -spacing)),
        dt=0.4 * spacing / SPEED, particle_volume=(spacing / 2) ** 3, gravity=(0.0, -GRAVITY, 0.0),
        material=Material(density=DENSITY, elasticity=Tait(speed_of_sound=SPEED)),
        walls=Walls(lower=(low, low, held(spacing)), upper=(high, None, held(spacing))),
    )  # fmt: skip
    return scene, mpm.initial_state(jnp.asarray(x))


def pressure(scene: mpm.MPMScene, state: mpm.MPMState) -> Any:
    """Cauchy pressure of every particle [Pa]."""
    F, tau = mpm.deform(scene, state)
    return -jnp.trace(tau, axis1=1, axis2=2) / 3.0 / cp.det(cp.split_matrix(F))


def height(scene: mpm.MPMScene, state: mpm.MPMState) -> Any:
    return jnp.mean(state.x[:, 1])


@in_float64
def run(scale: str = "small") -> dict[str, Any]:
    """Pressures at all particles and their mean in each layer of cells."""
    cells = CELLS[scale]
    scene, state = tank(cells)
    omega = np.pi / 2 * SPEED / DEPTH
    num_samples = round(RADIANS / (omega * scene.dt * EVERY))
    keep = float(np.exp(-2 * omega * scene.dt * EVERY))
    end, heights = record(scene, state, every=EVERY, num_samples=num_samples, observe=height, keep=keep)
    p, y = np.asarray(pressure(scene, end)), np.asarray(end.x[:, 1])
    layer = np.clip((y / scene.grid.spacing).astype(int), 0, cells - 1)
    mean, middle = (np.array([a[layer == k].mean() for k in range(cells)]) for a in (p, y))
    bottom = DENSITY * GRAVITY * DEPTH
    off = (mean - DENSITY * GRAVITY * (DEPTH - middle)) / bottom
    worst = 1 + int(np.argmax(np.abs(off[1:])))

    def check(what: str, k: int, error: float, bar: float) -> Check:
        theory = DENSITY * GRAVITY * (DEPTH - middle[k])
        return Check(
            what=what, measured=mean[k], theory=theory, unit="Pa", error=float(error), bar=bar, error_unit="rho g H"
        )

    checks = [
        check("pressure of the worst layer of cells above the lowest", worst, abs(off[worst]), 0.03),
        check("all layers, root mean square (middle one shown)", cells // 2, np.sqrt(np.mean(off**2)), 0.03),
        # Nodes behind the floor stand still instead of mirroring the water: this layer pays for it at any resolution.
        check("the lowest layer, on the floor", 0, abs(off[0]), 0.1),
    ]
    return {
        "checks": checks,
        "p": p,
        "y": y,
        "mean": mean,
        "middle": middle,
        "off": off,
        "heights": np.asarray(heights),
    }


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True)
    left.plot(results["p"] / 1e3, results["y"], ".", ms=2, alpha=0.4, label="particles")
    left.plot(results["mean"] / 1e3, results["middle"], "o", ms=4, mfc="none", label="mean of a layer of cells")
    left.plot([DENSITY * GRAVITY * DEPTH / 1e3, 0], [0, DEPTH], "k-", lw=1, label="rho g (H - y)")
    right.plot(100 * results["off"], results["middle"], "o-", ms=3)
    for bar in (-3, 3):
        right.axvline(bar, color="k", ls=":")
    left.set(xlabel="pressure [kPa]", ylabel="height y [m]")
    right.set(xlabel="error of a layer [% of rho g H]")
    left.legend(frameon=False, fontsize=8)
    save(figure, path)
