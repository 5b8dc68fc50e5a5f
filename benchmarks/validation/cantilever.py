"""A beam clamped at one end sags under its weight: at the tip 3 rho g L^4 / (2 E' h^2), says Euler-Bernoulli.

Plane strain, so E' = E / (1 - nu^2). A stub of two cells in a sticky wall holds the root; the motion is damped
critically until it stops. Shear, which this theory leaves out, adds 3/5 rho g L^2 / G (Timoshenko): 0.9 % of the
sag of a beam ten times as long as high. A sag of 1 % of the length keeps geometry linear.
"""

import itertools
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import Check, fill, held, in_float64, record, relative, save
from rewax.physics import mpm
from rewax.physics.mpm import Grid, Hencky, Material, Wall, WallKind, Walls, sound_speed

DEPTHS = {"tiny": (2, 4), "small": (3, 5), "full": (4, 8, 12)}
"""Cells over the height of the beam, one simulation each."""
HEIGHT, LENGTH, SAG = 0.1, 1.0, 0.01
RADIANS = 10.0
"""Duration times the first angular frequency: damped critically, 0.05 % of the way is left then."""
NU = 0.3
YOUNGS_MODULUS, DENSITY = 1e6, 1000.0
MATERIAL = Material(density=DENSITY, elasticity=Hencky(youngs_modulus=YOUNGS_MODULUS, poissons_ratio=NU))
PLANE_MODULUS = YOUNGS_MODULUS / (1 - NU**2)
GRAVITY = SAG * 2 * PLANE_MODULUS * HEIGHT**2 / (3 * DENSITY * LENGTH**4)
OMEGA = 3.516 / LENGTH**2 * float(np.sqrt(PLANE_MODULUS * HEIGHT**2 / (12 * DENSITY)))
SHEAR_SAG = 0.6 * DENSITY * GRAVITY * LENGTH**2 / (YOUNGS_MODULUS / (2 * (1 + NU)))
EVERY = 20


def deflection(x: np.ndarray) -> np.ndarray:
    """Euler-Bernoulli's line, downwards."""
    s = x / LENGTH
    return SAG / 3 * s**2 * (6 - 4 * s + s**2)


def beam(depth: int) -> tuple[mpm.MPMScene, mpm.MPMState]:
    spacing = HEIGHT / depth
    x = fill((-2 * spacing, 0.0), (LENGTH, HEIGHT), spacing)
    shape = (round(LENGTH / spacing) + 7, depth + 7, 4)
    root = Wall(position=0.5 * spacing, kind=WallKind.STICKY)
    scene = mpm.make_scene(
        grid=Grid(shape=shape, spacing=spacing, origin=(-4 * spacing, -3.5 * spacing, -spacing)),
        dt=0.4 * spacing / float(sound_speed(MATERIAL)), material=MATERIAL, particle_volume=(spacing / 2) ** 3,
        gravity=(0.0, -GRAVITY, 0.0),
        walls=Walls(lower=(root, None, held(spacing)), upper=(None, None, held(spacing))),
    )  # fmt: skip
    return scene, mpm.initial_state(jnp.asarray(x))


def tip(scene: mpm.MPMScene, state: mpm.MPMState) -> Any:
    """Height of the particles at the free end; the particles are ordered along x."""
    return jnp.mean(state.x[-2 * round(HEIGHT / scene.grid.spacing) :, 1])


def settle(depth: int) -> dict[str, Any]:
    """The tip's way over time and the beam's line at the end, both downwards."""
    scene, state = beam(depth)
    num_samples = round(RADIANS / (OMEGA * scene.dt * EVERY))
    keep = float(np.exp(-2 * OMEGA * scene.dt * EVERY))
    end, heights = record(scene, state, every=EVERY, num_samples=num_samples, observe=tip, keep=keep)
    line = np.asarray(state.x - end.x)[:, 1].reshape(-1, 2 * depth).mean(axis=1)
    X = np.asarray(state.x)[:, 0].reshape(-1, 2 * depth).mean(axis=1)
    t = scene.dt * EVERY * np.arange(1, num_samples + 1)
    # The last column of particles is a quarter of a cell short of the tip.
    sag = line[-1] + (line[-1] - line[-2]) / 2
    return {"depth": depth, "t": t, "tip": HEIGHT / 2 - np.asarray(heights), "X": X, "line": line, "sag": float(sag)}


@in_float64
def run(scale: str = "small") -> dict[str, Any]:
    """Sag at the tip for every depth; the finest must be within the bar, and each better than the coarser one."""
    beams = [settle(depth) for depth in DEPTHS[scale]]
    errors = [abs(b["sag"] / SAG - 1) for b in beams]
    worst = max(b / a for a, b in itertools.pairwise(errors))
    finest = beams[-1]["sag"]
    checks = [
        relative(f"tip sag against Euler-Bernoulli, {DEPTHS[scale][-1]} cells high", finest, SAG, 0.05, "m"),
        relative("the same against Timoshenko", finest, SAG + SHEAR_SAG, 0.05, "m"),
        Check(
            what="errors of successive depths, largest ratio",
            measured=worst,
            theory=0.0,
            error=worst,
            bar=1.0,
            error_unit="ratio",
        ),
    ]
    return {"checks": checks, "beams": beams, "errors": errors}


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2))
    s = np.linspace(0, LENGTH, 100)
    left.plot(s, -1e3 * deflection(s), "k-", lw=1, label="Euler-Bernoulli")
    for one in results["beams"]:
        left.plot(one["X"], -1e3 * one["line"], "--", lw=1.5, label=f"{one['depth']} cells high")
    left.set(xlabel="x [m]", ylabel="deflection [mm]", xlim=(0, LENGTH))
    depths, sags = ([one[name] for one in results["beams"]] for name in ("depth", "sag"))
    for name, theory, style in (("Euler-Bernoulli", SAG, "o-"), ("Timoshenko", SAG + SHEAR_SAG, "s-")):
        right.semilogy(depths, [100 * abs(sag / theory - 1) for sag in sags], style, label=f"against {name}")
    right.axhline(100 * SHEAR_SAG / SAG, color="k", ls=":", label="difference of the theories")
    right.set(xlabel="height of the beam [cells]", ylabel="error of the tip's sag [%]", xticks=depths)
    right.set_yticks([0.2, 0.5, 1.0, 2.0, 5.0], labels=["0.2", "0.5", "1", "2", "5"])
    right.tick_params(axis="y", which="minor", labelleft=False)
    for panel in (left, right):
        panel.legend(frameon=False, fontsize=8)
    save(figure, path)
