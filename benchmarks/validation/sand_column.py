"""Columns of sand collapse: how far they run out, against the experiments of Lube et al. (2005).

A column of width d_0 and height a d_0 stands beside a wall and is let go: (d - d_0) / d_0 = 1.2 a for a < 1.8 and
1.9 a^(2/3) for a > 2.8 in a channel, whatever the grains and the floor. Drucker-Prager sand in plane strain on a
frictional floor. Columns of all aspect ratios hold about the same number of particles, so they are one batch of one
program; exponents are fitted on both sides of the transition.

``Material.friction_angle`` is that of triaxial compression. Where sand flows without change of volume in plane strain,
the same cone gives sin(angle) = 2 sqrt(3) sin(phi) / (3 - sin(phi)), 30 degrees from phi = 22.2.
"""

import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import Check, foremost, held, record, relative, save
from rewax.physics import mpm
from rewax.physics.mpm import DruckerPrager, Grid, Hencky, Material, Wall, Walls, sound_speed
from rewax.status import Status

LOW, HIGH = 1.8, 2.8
"""Between these aspect ratios the law changes."""
SIZES = {
    "tiny": ((22, 12), (13, 20), (9, 28), (5, 52)),
    "small": ((32, 16), (24, 22), (18, 28), (12, 42), (10, 51), (8, 64), (6, 85)),
    "full": ((64, 32), (48, 43), (36, 57), (26, 78), (22, 93), (18, 114), (15, 136), (12, 170)),
}
"""Particles along and up the columns, two per cell and axis."""
SINE, FLOOR_FRICTION = math.sin(math.radians(30.0)), 1.0
"""Sine of the friction angle that acts in plane strain; quartz sand's angle of repose is 29.5 degrees."""
FRICTION_ANGLE = math.asin(3 * SINE / (2 * math.sqrt(3) + SINE))
"""The material's own [rad], 22.2 degrees: a cone for triaxial compression allows more in plane strain."""
GRAVITY, DENSITY, SPACING = 9.81, 1500.0, 0.01
EVERY = 10
BAR_RUN_OUT = {"tiny": 0.3, "small": 0.3, "full": 0.2}
BAR_EXPONENT = {"tiny": 0.25, "small": 0.25, "full": 0.15}
"""Small columns are few cells wide, and their deposits end in toes less than a cell high."""


def columns(sizes: tuple[tuple[int, int], ...]) -> tuple[mpm.MPMScene, np.ndarray]:
    """The scene, and positions of the particles of all columns, shape (num_columns, num_particles, 3)."""
    num = min(a * b for a, b in sizes)
    h = SPACING / 2
    # Row by row from below; what the last row has too many is left out.
    k, zero = np.arange(num), np.zeros(num)
    x = np.stack([np.stack([(k % a + 0.5) * h, (k // a + 0.5) * h, zero], axis=1) for a, _ in sizes])
    height = max(b for _, b in sizes) * h
    reach = max(a * h * (1 + max(1.6 * (b / a), 2.4 * (b / a) ** (2 / 3))) for a, b in sizes)
    material = Material(
        density=DENSITY,
        elasticity=Hencky(youngs_modulus=60 * DENSITY * GRAVITY * height, poissons_ratio=0.3),
        plasticity=DruckerPrager(friction_angle=FRICTION_ANGLE),
    )
    side, floor = Wall(position=0.5 * SPACING), Wall(position=0.5 * SPACING, friction=FLOOR_FRICTION)
    shape = (round(reach / SPACING) + 8, round(height / SPACING) + 7, 4)
    scene = mpm.make_scene(
        grid=Grid(shape=shape, spacing=SPACING, origin=(-2 * SPACING, -2 * SPACING, -SPACING)),
        dt=0.35 * SPACING / float(sound_speed(material)), material=material, particle_volume=h**3,
        gravity=(0.0, -GRAVITY, 0.0),
        walls=Walls(lower=(side, floor, held(SPACING)), upper=(None, None, held(SPACING))),
        max_active_nodes=min(4 * shape[0] * shape[1], 4 * (2 * num + 40 * int(num**0.5))),
    )  # fmt: skip
    return scene, x


def observe(scene: mpm.MPMScene, state: mpm.MPMState) -> dict[str, Any]:
    """The front, with half a particle's width, and how fast all particles are."""
    return {"front": foremost(state) + scene.grid.spacing / 4, "speed": jnp.sqrt(jnp.mean(state.v**2))}


def run(scale: str = "small") -> dict[str, Any]:
    """Run-outs over aspect ratios and the exponents below and above the transition."""
    sizes = SIZES[scale]
    scene, x = columns(sizes)
    height = max(b for _, b in sizes) * SPACING / 2
    num_samples = round(5.0 * np.sqrt(height / GRAVITY) / (scene.dt * EVERY))
    batch = jax.vmap(
        lambda x: record(scene, mpm.initial_state(x), every=EVERY, num_samples=num_samples, observe=observe)
    )
    end, seen = batch(jnp.asarray(x, jnp.float32))
    status = int(np.bitwise_or.reduce(np.asarray(jax.vmap(lambda s: mpm.check_status(scene, s, start=s))(end))))
    if status & ~Status.OUT_OF_DOMAIN:
        raise RuntimeError(f"the simulation failed: status {status}")
    front, speed = np.asarray(seen["front"]), np.asarray(seen["speed"])
    width = np.array([a for a, _ in sizes]) * SPACING / 2
    aspect = x.shape[1] / np.array([a for a, _ in sizes]) ** 2
    run_out = (front[:, -1] - width) / width
    results: dict[str, Any] = {
        "aspect": aspect,
        "run_out": run_out,
        "x": np.asarray(end.x),
        "width": width,
        "checks": [],
    }
    results["t"] = scene.dt * EVERY * np.arange(1, num_samples + 1)
    results["front"], results["speed"] = front, speed
    off = np.nan_to_num(run_out / lube(aspect) - 1)
    k = int(np.argmax(np.abs(off)))
    results["checks"].append(
        relative(f"run-out where it is worst, a = {aspect[k]:.2g}", run_out[k], lube(aspect)[k], BAR_RUN_OUT[scale])
    )
    for name, those, theory in (("low", aspect < LOW, 1.0), ("tall", aspect > HIGH, 2 / 3)):
        if those.sum() < 2:
            continue
        exponent, factor = np.polyfit(np.log(aspect[those]), np.log(run_out[those]), 1)
        results[name] = exponent, np.exp(factor)
        results["checks"].append(
            Check(
                what=f"exponent of the run-out of {name} columns",
                measured=float(exponent),
                theory=theory,
                error=abs(float(exponent) / theory - 1),
                bar=BAR_EXPONENT[scale],
            )
        )
    return results


def lube(aspect: np.ndarray) -> np.ndarray:
    """Their run-out (d - d_0) / d_0, not a number in the transition."""
    return np.where(aspect < LOW, 1.2 * aspect, np.where(aspect > HIGH, 1.9 * aspect ** (2 / 3), np.nan))


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4))
    a = np.geomspace(0.9 * results["aspect"].min(), 1.1 * results["aspect"].max(), 200)
    left.loglog(a, lube(a), "k-", lw=1, label="Lube et al. 2005")
    left.loglog(results["aspect"], results["run_out"], "o", ms=4, label="simulation")
    left.set(xlabel="aspect ratio a [-]", ylabel="run-out (d - d_0) / d_0 [-]")
    left.legend(frameon=False, fontsize=8)
    k = len(results["width"]) - 1
    right.plot(*(results["x"][k, :, :2] / results["width"][k]).T, ".", ms=1)
    right.set(xlabel="x / d_0 [-]", ylabel="y / d_0 [-]", title=f"deposit of a = {results['aspect'][k]:.1f}")
    save(figure, path)
