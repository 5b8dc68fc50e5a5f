"""A block on an incline: at rest below the friction angle, sliding with g (sin a - mu cos a) above it.

The plane stays put and gravity turns. A frictional wall and a frictional plane collider, each with gravity at many
angles in one batch. Plane strain; the block is longer than high, so that it does not tip over.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import Check, fill, held, in_float64, record, save
from rewax.physics import mpm
from rewax.physics.colliders import Collider, Wall, Walls
from rewax.physics.grid import Grid
from rewax.physics.materials import Material, sound_speed
from rewax.physics.sdf import Plane

FRICTION_ANGLE, GRAVITY = 30.0, 9.81
SIZES = {"tiny": (2, (28.0, 32.0)), "small": (4, tuple(np.arange(25.0, 40.1, 1.0))), "full": (8, tuple(np.arange(25.0, 40.1, 0.5)))}
"""Cells over the block's height, angles in degrees."""
HEIGHT, LENGTH, TRAVEL, DURATION = 0.1, 0.3, 0.35, 0.5
EVERY = 10
STUCK = 0.01
"""A block is stuck that accelerates by less than this in the second half of the time [g]."""
MATERIAL = Material(youngs_modulus=2e5, poissons_ratio=0.3, density=1000.0)


def block(cells: int, with_collider: bool) -> tuple[mpm.MPMScene, mpm.MPMState]:
    spacing = HEIGHT / cells
    x = fill((0.0, 0.0), (LENGTH, HEIGHT), spacing)
    mu = float(np.tan(np.radians(FRICTION_ANGLE)))
    # The plane lies where the block's lower face is; the nodes on it belong to both.
    floor = None if with_collider else Wall(position=0.5 * spacing, friction=mu)
    plane = Collider(shape=Plane(), offset=jnp.zeros(3), rotation=jnp.eye(3), friction=mu, softness=20.0 / spacing)
    scene = mpm.make_scene(
        grid=Grid(shape=(round((LENGTH + TRAVEL) / spacing) + 8, cells + 7, 4), spacing=spacing,
                  origin=(-4 * spacing, -3 * spacing, -spacing)),
        dt=0.4 * spacing / float(sound_speed(MATERIAL) + 1.0), material=MATERIAL, particle_volume=(spacing / 2) ** 3,
        colliders=(plane,) if with_collider else (),
        walls=Walls(lower=(None, floor, held(spacing)), upper=(None, None, held(spacing))),
    )  # fmt: skip
    return scene, mpm.initial_state(jnp.asarray(x))


def velocity(scene: mpm.MPMScene, state: mpm.MPMState) -> Any:
    return jnp.mean(state.v[:, 0])


def accelerations(scene: mpm.MPMScene, state: mpm.MPMState, angles: np.ndarray) -> np.ndarray:
    """Mean acceleration down the plane over the second half of the time, for each angle [m/s^2]."""
    num_samples = round(DURATION / (scene.dt * EVERY))
    poses = mpm.static_poses(num_samples * EVERY, len(scene.colliders), state.x.dtype)
    a = np.radians(angles)
    gravity = GRAVITY * jnp.stack([jnp.sin(a), -jnp.cos(a), jnp.zeros(len(a))], axis=1)

    def slide(g: jax.Array) -> jax.Array:
        return record(scene.replace(gravity=g), state, every=EVERY, num_samples=num_samples, observe=velocity, poses=poses)[1]

    v = np.asarray(jax.vmap(slide)(gravity))
    t = scene.dt * EVERY * np.arange(1, num_samples + 1)
    late = t > DURATION / 2
    return np.array([np.polyfit(t[late], one[late], 1)[0] for one in v])


@in_float64
def run(scale: str = "small") -> dict[str, Any]:
    """Accelerations over angles; the friction angle lies between the last stuck and the first sliding block."""
    cells, angles = SIZES[scale]
    angles = np.asarray(angles)
    theory = GRAVITY * np.maximum(np.sin(np.radians(angles)) - np.tan(np.radians(FRICTION_ANGLE)) * np.cos(np.radians(angles)), 0.0)
    results: dict[str, Any] = {"checks": [], "angles": angles, "theory": theory}
    for name, with_collider in (("wall", False), ("collider", True)):
        a = accelerations(*block(cells, with_collider), angles)
        results[name] = a
        stuck = np.abs(a) < STUCK * GRAVITY
        between = (angles[stuck].max(initial=-90.0) + angles[~stuck].min(initial=90.0)) / 2
        sliding = angles > FRICTION_ANGLE + 1.5
        off = float(np.max(np.abs(a - theory)[sliding]) / GRAVITY)
        results["checks"] += [
            Check(what=f"{name}: angle at which the block begins to slide", measured=float(between), theory=FRICTION_ANGLE,
                  unit="deg", error=abs(float(between) - FRICTION_ANGLE), bar=2.0, error_unit="deg"),
            Check(what=f"{name}: acceleration at {angles[-1]:g} degrees", measured=float(a[-1]), theory=float(theory[-1]),
                  unit="m/s2", error=off, bar=0.02, error_unit="g, at worst"),
        ]  # fmt: skip
    return results


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, panel = plt.subplots(figsize=(5, 3.4))
    panel.plot(results["angles"], results["theory"], "k-", lw=1, label="theory")
    panel.plot(results["angles"], results["wall"], "o", ms=4, label="wall")
    panel.plot(results["angles"], results["collider"], "x", ms=5, label="plane collider")
    for bar in (-2, 2):
        panel.axvline(FRICTION_ANGLE + bar, color="k", ls=":")
    panel.set(xlabel="angle of the plane [degrees]", ylabel="acceleration down the plane [m/s²]")
    panel.legend(frameon=False, fontsize=8)
    save(figure, path)
