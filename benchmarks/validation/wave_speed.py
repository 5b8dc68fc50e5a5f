"""Elastic waves along a bar: speed from the fundamental longitudinal frequency, c = 2 L f.

Two bars with free ends, each started with the velocity of its first mode, cos(pi x / L):

- confined: nothing moves sideways, so the wave is the pressure wave, sqrt((lambda + 2 mu) / density);
- slender: free sides, so it is the bar wave, sqrt(E / density), slower by Poisson's ratio; the sideways inertia of a
  bar 1/10 as wide as long takes 0.07 % off that (Love's correction), which counts as error.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import fill, fit_oscillation, held, in_float64, record, relative, save
from rewax.physics import mpm
from rewax.physics.mpm import Grid, Hencky, Material, Walls, sound_speed

SIZES = {"tiny": (16, 10, 1), "small": (40, 20, 2), "full": (80, 40, 4)}
"""Cells along the confined bar, along the slender bar, across the slender bar."""
LENGTH, STRAIN, PERIODS = 1.0, 1e-7, 2.0
YOUNGS_MODULUS, DENSITY = 1e6, 1000.0
MATERIAL = Material(density=DENSITY, elasticity=Hencky(youngs_modulus=YOUNGS_MODULUS, poissons_ratio=0.3))
BAR_SPEED = float(np.sqrt(YOUNGS_MODULUS / DENSITY))


def free_bar(cells: int, across: int | None, dt: float | None = None) -> tuple[mpm.MPMScene, mpm.MPMState]:
    """A bar from x = 0 to LENGTH, in its first longitudinal mode at zero displacement; confined if across is None."""
    spacing = LENGTH / cells
    if across is None:
        x = fill((0.0,), (LENGTH,), spacing)
        shape, origin, walls = (
            (4, 4),
            -spacing,
            Walls(lower=(None, *2 * (held(spacing),)), upper=(None, *2 * (held(spacing),))),
        )
        speed = float(sound_speed(MATERIAL))
    else:
        half = across * spacing / 2
        x = fill((0.0, -half, -half), (LENGTH, half, half), spacing)
        shape, origin, walls = 2 * (across + 5,), -half - 2 * spacing, Walls(lower=3 * (None,), upper=3 * (None,))
        speed = BAR_SPEED
    scene = mpm.make_scene(
        grid=Grid(shape=(cells + 6, *shape), spacing=spacing, origin=(-2.5 * spacing, origin, origin)),
        dt=0.3 * spacing / float(sound_speed(MATERIAL)) if dt is None else dt,
        material=MATERIAL, particle_volume=(spacing / 2) ** 3, gravity=(0.0, 0.0, 0.0), walls=walls,
    )  # fmt: skip
    state = mpm.initial_state(jnp.asarray(x))
    k = np.pi / LENGTH
    C = np.zeros((len(x), 3, 3))
    C[:, 0, 0] = -STRAIN * speed * k * np.sin(k * x[:, 0])
    v = np.zeros_like(x)
    v[:, 0] = STRAIN * speed * np.cos(k * x[:, 0])
    return scene, state.replace(v=jnp.asarray(v), C=jnp.asarray(C))


def amplitude(scene: mpm.MPMScene, state: mpm.MPMState) -> Any:
    """How much of the velocity is in the first mode."""
    return 2.0 * jnp.mean(state.v[:, 0] * jnp.cos(np.pi / LENGTH * state.x[:, 0]))


@in_float64
def run(scale: str = "small") -> dict[str, Any]:
    """Speeds of the two waves and the modes' amplitudes over time."""
    confined, slender, across = SIZES[scale]
    results: dict[str, Any] = {"checks": []}
    for name, scene_and_state, theory in (
        ("confined", free_bar(confined, None), float(sound_speed(MATERIAL))),
        ("slender", free_bar(slender, across), BAR_SPEED),
    ):
        scene, state = scene_and_state
        num_samples = round(PERIODS * 2 * LENGTH / (theory * scene.dt))
        _, a = record(scene, state, every=1, num_samples=num_samples, observe=amplitude)
        t, a = scene.dt * np.arange(1, num_samples + 1), np.asarray(a)
        fit = fit_oscillation(t, a, np.pi * theory / LENGTH)
        speed = fit["omega"] * LENGTH / np.pi
        results["checks"].append(relative(f"{name} bar: speed of the wave", speed, theory, 0.03, "m/s"))
        results[name] = {
            "t": t * theory / (2 * LENGTH),
            "a": a / (STRAIN * theory),
            "decay": fit["decay"] / fit["omega"],
        }
    return results


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, panels = plt.subplots(1, 2, figsize=(9, 3), sharey=True)
    for panel, name, check in zip(panels, ("confined", "slender"), results["checks"], strict=True):
        t, a = results[name]["t"], results[name]["a"]
        panel.plot(t, np.cos(2 * np.pi * t), "k-", lw=1, label="theory")
        step = max(1, len(t) // 60)
        panel.plot(t[::step], a[::step], "o", ms=3, label="simulation")
        panel.set(xlabel="time / theoretical period [-]", title=f"{name} bar: speed {100 * check.error:.2g} % off")
    panels[0].set_ylabel("first mode's velocity [start]")
    panels[0].legend(frameon=False, fontsize=8, loc="lower left")
    save(figure, path)
