"""An elastic, perfectly plastic bar between two plates: what strain remains after unloading?

A frictionless plate presses a bar (von Mises, free sides) slowly to a strain of some 5 % and lets go. In uniaxial
stress Hencky's law is tau = E e in logarithmic strain, and a limit on the Frobenius norm of the deviator means yield at
tau_y = sqrt(3/2) yield_stress; so the strain that remains is the largest one less tau_y / E. Strains are those of the
middle half of the bar, from the particles' positions: the plate acts through nodes, up to a cell away from the bar.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import fill, in_float64, record, relative, save
from rewax.physics import mpm
from rewax.physics.contact import Collider
from rewax.physics.mpm import Grid, Hencky, Material, VonMises, Wall, Walls, sound_speed
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Plane

SIZES = {"tiny": (12, 3), "small": (12, 4), "full": (24, 6)}
"""Cells along and across the bar."""
LENGTH, YIELD_STRAIN, STRAIN = 1.0, 0.01, 0.04
TRANSITS = {"tiny": 20.0, "small": 30.0, "full": 60.0}
"""How often a wave goes along the bar while the plate comes down."""
EVERY = 10
E, DENSITY = 1e6, 1000.0
TAU_Y = YIELD_STRAIN * E
MATERIAL = Material(
    density=DENSITY,
    elasticity=Hencky(youngs_modulus=E, poissons_ratio=0.3),
    plasticity=VonMises(yield_stress=TAU_Y / float(np.sqrt(1.5))),
)


def bar(cells: int, across: int) -> tuple[mpm.MPMScene, mpm.MPMState]:
    spacing = LENGTH / cells
    half = across * spacing / 2
    x = fill((-half, 0.0, -half), (half, LENGTH, half), spacing)
    plate = Collider(
        shape=Plane(), offset=jnp.zeros(3), rotation=jnp.diag(jnp.asarray([1.0, -1.0, -1.0])), friction=0.0,
        softness=20.0 / spacing,
    )  # fmt: skip
    scene = mpm.make_scene(
        grid=Grid(shape=(across + 7, cells + 7, across + 7), spacing=spacing,
                  origin=(-half - 3 * spacing, -3 * spacing, -half - 3 * spacing)),
        dt=0.3 * spacing / float(sound_speed(MATERIAL)), material=MATERIAL, particle_volume=(spacing / 2) ** 3,
        gravity=(0.0, 0.0, 0.0), colliders=(plate,),
        walls=Walls(lower=(None, Wall(position=0.5 * spacing), None), upper=(None, None, None)),
    )  # fmt: skip
    return scene, mpm.initial_state(jnp.asarray(x))


def plate_heights(num: int, gap: float) -> np.ndarray:
    """Down for two thirds of the time, up for a third, with a smooth start, turn and end."""
    s = np.linspace(0.0, 1.0, num)
    down = np.clip(s / 0.6, 0, 1)
    up = np.clip((s - 0.65) / 0.3, 0, 1)
    ease = lambda a: a * a * (3 - 2 * a)  # noqa: E731
    travel = STRAIN * LENGTH + gap
    return LENGTH - travel * ease(down) + 1.5 * travel * ease(up)


def middle(scene: mpm.MPMScene, state: mpm.MPMState) -> dict[str, Any]:
    """Along the bar: mean logarithmic strain and mean Kirchhoff stress of its middle half."""
    cells = round(LENGTH / scene.grid.spacing)
    across = 2 * (scene.grid.shape[0] - 7)
    _, tau = mpm.deform(scene, state)

    def part(a: Any) -> Any:  # by rows along the bar: the lattice's order is x, y, z
        return a.reshape(across, 2 * cells, across)[:, cells // 2 : 2 * cells - cells // 2].mean(axis=(0, 2))

    y = part(state.x[:, 1])
    Y = (jnp.arange(y.shape[0]) - (y.shape[0] - 1) / 2) * scene.grid.spacing / 2
    stretch = jnp.sum(Y * y) / jnp.sum(Y * Y)
    return {"strain": jnp.log(stretch), "stress": jnp.mean(part(tau[:, 1, 1]))}


@in_float64
def run(scale: str = "small") -> dict[str, Any]:
    """Strain and stress of the bar's middle over a cycle; remaining strain, flow stress and modulus."""
    scene, state = bar(*SIZES[scale])
    duration = 2 * TRANSITS[scale] * LENGTH / float(np.sqrt(E / DENSITY))
    num_samples = round(duration / (scene.dt * EVERY))
    y = plate_heights(num_samples * EVERY + 1, scene.grid.spacing)
    position = jnp.stack([jnp.zeros_like(y), jnp.asarray(y), jnp.zeros_like(y)], axis=-1)[:, None]
    poses = Pose(position, jnp.broadcast_to(jnp.eye(3), (len(y), 1, 3, 3)))
    # Waves along the bar calm down within a few transits; the plate is much slower.
    keep = float(np.exp(-0.5 * np.sqrt(E / DENSITY) / LENGTH * scene.dt * EVERY))
    _, seen = record(scene, state, every=EVERY, num_samples=num_samples, observe=middle, poses=poses, keep=keep)
    strain, stress = -np.asarray(seen["strain"]), -np.asarray(seen["stress"])
    peak = strain.max()
    flowing = (strain > 2 * YIELD_STRAIN) & (np.arange(num_samples) < np.argmax(strain))
    elastic = (
        (strain > 0.2 * YIELD_STRAIN) & (strain < 0.8 * YIELD_STRAIN) & (np.arange(num_samples) < np.argmax(strain))
    )
    late = slice(-max(1, num_samples // 50), None)
    checks = [
        relative("strain that remains after unloading", strain[late].mean(), peak - YIELD_STRAIN, 0.03),
        relative("stress while it flows", stress[flowing].mean(), TAU_Y, 0.03, "Pa"),
        relative("Young's modulus on loading", np.polyfit(strain[elastic], stress[elastic], 1)[0], E, 0.03, "Pa"),
    ]
    return {"checks": checks, "strain": strain, "stress": stress}


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, panel = plt.subplots(figsize=(5, 3.4))
    strain = results["strain"]
    peak = strain.max()
    theory = [0, YIELD_STRAIN, peak, peak - YIELD_STRAIN], [0, TAU_Y, TAU_Y, 0]
    panel.plot(100 * np.asarray(theory[0]), np.asarray(theory[1]) / 1e3, "k-", lw=1, label="theory")
    step = max(1, len(strain) // 100)
    panel.plot(100 * strain[::step], results["stress"][::step] / 1e3, "o", ms=3, label="simulation, middle of the bar")
    panel.set(xlabel="logarithmic compression [%]", ylabel="Kirchhoff stress, compression [kPa]")
    panel.legend(frameon=False, fontsize=8, loc="lower center")
    save(figure, path)
