"""A block on an incline: at rest below the friction angle, sliding with g (sin a - mu cos a) above it.

Twice: on a frictional wall of the grid's box, where gravity turns; and on a frictional plane collider, which turns
within the grid together with the block. All angles are one batch. Plane strain; the block is three times as long as
high, so that it does not tip over.
"""

import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import Check, fill, held, in_float64, record, save
from rewax.physics import mpm
from rewax.physics.contact import Collider
from rewax.physics.mpm import Grid, Hencky, Material, Newtonian, Wall, Walls, sound_speed
from rewax.physics.shapes import Plane

FRICTION_ANGLE, GRAVITY = 30.0, 9.81
SIZES = {
    "tiny": (2, (28.0, 32.0)),
    "small": (4, (26.0, 28.0, 29.0, 30.0, 31.0, 32.0, 35.0, 40.0)),
    "full": (6, tuple(np.arange(25.0, 40.1, 1.0))),
}
"""Cells over the block's height, angles in degrees."""
MU = math.tan(math.radians(FRICTION_ANGLE))
HEIGHT, LENGTH, TRAVEL, DURATION = 0.1, 0.3, 0.35, 0.5
EVERY = 10
STUCK = 0.01
"""A block is stuck that accelerates by less than this in the second half of the time [g]."""
MATERIAL = Material(
    density=1000.0,
    elasticity=Hencky(youngs_modulus=2e5, poissons_ratio=0.3),
    viscosity=Newtonian(viscosity=200.0),
)
"""Viscosity calms the block: while it rattles, its nodes lose their grip in turns, and it creeps below the angle."""


def on_wall(cells: int) -> tuple[mpm.MPMScene, np.ndarray]:
    """A frictional wall of the grid's box; gravity will be turned."""
    spacing = HEIGHT / cells
    floor = Wall(position=0.5 * spacing, friction=MU)
    shape = (round((LENGTH + TRAVEL) / spacing) + 8, cells + 7, 4)
    return _scene(spacing, shape, (-4.0, -3.0), (), floor), fill((0.0, 0.0), (LENGTH, HEIGHT), spacing)


def on_plane(cells: int) -> tuple[mpm.MPMScene, np.ndarray]:
    """A plane collider; it and the block will be turned within the grid."""
    spacing = HEIGHT / cells
    x = fill((0.0, 0.0), (LENGTH, HEIGHT), spacing)
    plane = Collider(shape=Plane(), offset=jnp.zeros(3), rotation=jnp.eye(3), friction=MU, softness=20.0 / spacing)
    down = math.ceil((LENGTH + TRAVEL) * math.sin(math.radians(40.0)) / spacing)
    shape = (round((LENGTH + TRAVEL) / spacing) + 8, cells + 7 + down, 4)
    return _scene(spacing, shape, (-4.0, -3.0 - down), (plane,), None), x


def _scene(
    spacing: float, shape: tuple[int, int, int], origin: tuple[float, float], colliders: Any, floor: Any
) -> mpm.MPMScene:
    grid = Grid(shape=shape, spacing=spacing, origin=(origin[0] * spacing, origin[1] * spacing, -spacing))
    dt = min(0.3 * spacing / float(sound_speed(MATERIAL) + 1.0), 0.9 * float(mpm.largest_stable_dt(MATERIAL, grid)))
    return mpm.make_scene(
        grid=grid, dt=dt, material=MATERIAL, particle_volume=(spacing / 2) ** 3,
        colliders=colliders, walls=Walls(lower=(None, floor, held(spacing)), upper=(None, None, held(spacing))),
    )  # fmt: skip


def velocity(scene: mpm.MPMScene, state: mpm.MPMState) -> Any:
    return jnp.mean(state.v, axis=0)


def accelerations(scene: mpm.MPMScene, x: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Mean acceleration down the plane over the second half of the time, for each angle [m/s^2]."""
    num_samples = round(DURATION / (scene.dt * EVERY))
    poses = mpm.static_poses(2 * num_samples * EVERY, len(scene.colliders), jnp.zeros(()).dtype)

    def slide(angle: jax.Array) -> jax.Array:
        c, s, o = jnp.cos(angle), jnp.sin(angle), jnp.zeros(())
        downhill, normal, z = jnp.stack([c, -s, o]), jnp.stack([s, c, o]), jnp.asarray([0.0, 0.0, 1.0])
        turn = jnp.stack([downhill, normal, z], axis=1)
        if scene.colliders:
            there = scene.replace(colliders=tuple(p.replace(rotation=turn) for p in scene.colliders))
            state, direction = mpm.initial_state(x @ turn.T), downhill
            before, after = -GRAVITY * normal, jnp.asarray([0.0, -GRAVITY, 0.0])
        else:
            there, state, direction = scene, mpm.initial_state(jnp.asarray(x)), jnp.asarray([1.0, 0.0, 0.0])
            before, after = jnp.asarray([0.0, -GRAVITY, 0.0]), GRAVITY * jnp.stack([s, -c, o])
        # First the block comes to rest, damped, pressed onto the plane by a gravity at right angles to it.
        settles = jnp.arange(2 * num_samples)[:, None] < num_samples
        gravity, keep = jnp.where(settles, before, after), jnp.where(settles[:, 0], 0.9, 1.0)
        _, v = record(
            there,
            state,
            every=EVERY,
            num_samples=2 * num_samples,
            observe=velocity,
            poses=poses,
            keep=keep,
            gravity=gravity,
        )
        return v[num_samples:] @ direction

    v = np.asarray(jax.vmap(slide)(jnp.radians(jnp.asarray(angles))))
    t = scene.dt * EVERY * np.arange(1, num_samples + 1)
    late = t > DURATION / 2
    return np.array([np.polyfit(t[late], one[late], 1)[0] for one in v])


@in_float64
def run(scale: str = "small") -> dict[str, Any]:
    """Accelerations over angles; the friction angle lies between the last stuck and the first sliding block."""
    cells, angles = SIZES[scale]
    angles = np.asarray(angles)
    theory = GRAVITY * np.maximum(np.sin(np.radians(angles)) - MU * np.cos(np.radians(angles)), 0.0)
    results: dict[str, Any] = {"checks": [], "angles": angles, "theory": theory}
    for name, scene_and_positions in (("wall", on_wall(cells)), ("collider", on_plane(cells))):
        a = accelerations(*scene_and_positions, angles)
        results[name] = a
        stuck = np.abs(a) < STUCK * GRAVITY
        between = (angles[stuck].max(initial=-90.0) + angles[~stuck].min(initial=90.0)) / 2
        sliding = angles > FRICTION_ANGLE + 1.5
        off = float(np.max(np.abs(a - theory)[sliding]) / GRAVITY)
        results["checks"] += [
            Check(
                what=f"{name}: angle at which the block begins to slide",
                measured=float(between),
                theory=FRICTION_ANGLE,
                unit="deg",
                error=abs(float(between) - FRICTION_ANGLE),
                bar=2.0,
                error_unit="deg",
            ),
            Check(
                what=f"{name}: acceleration at {angles[-1]:g} degrees",
                measured=float(a[-1]),
                theory=float(theory[-1]),
                unit="m/s2",
                error=off,
                bar=0.02,
                error_unit="g, at worst",
            ),
        ]
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
