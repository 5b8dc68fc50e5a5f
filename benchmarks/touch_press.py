"""Picture of touch: a plate presses a cube of dough and leaves it; forces of plate and floor over time.

python benchmarks/touch_press.py docs/pictures/touch_press.png
"""

import sys

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from rewax.physics import mpm
from rewax.physics.contact import WALLS, Collider, Patches
from rewax.physics.mpm import Grid, Hencky, Material, VonMises, Wall, WallKind, Walls
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Box
from rewax.physics.shapes.sampling import fill_box

DT, SUBSTEPS, STEPS, SPACING, EDGE = 2e-4, 50, 100, 0.02, 0.08
FLOOR = 0.0601


def scene_and_particles():
    x = fill_box((0.14, FLOOR + 0.5 * EDGE, 0.14), (EDGE,) * 3, 0.5 * SPACING)
    walls = Walls(lower=(None, Wall(position=FLOOR, kind=WallKind.GRIPPING), None), upper=(None,) * 3)
    material = Material(
        density=1000.0,
        elasticity=Hencky(youngs_modulus=2e4, poissons_ratio=0.3),
        plasticity=VonMises(yield_stress=600.0),
    )
    scene = mpm.make_scene(
        grid=Grid(shape=(15, 15, 15), spacing=SPACING), dt=DT, material=material, gravity=(0.0, -9.81, 0.0),
        particle_volume=EDGE**3 / len(x), walls=walls,
        colliders=(Collider(shape=Box(half_size=(0.1, 0.01, 0.1)), friction=0.5),),
    )  # fmt: skip
    return scene, mpm.initial_state(jnp.asarray(x), scene)


def main(out: str) -> None:
    scene, state = scene_and_particles()
    patches = Patches(body=(0, WALLS))
    time = DT * SUBSTEPS * np.arange(STEPS + 1)
    bottom = FLOOR + EDGE + 0.025 - 0.05 * np.sin(np.pi * time / time[-1]) ** 2
    fine = np.interp(np.arange(STEPS * SUBSTEPS + 1) * DT, time, bottom + 0.01)
    heights = jnp.asarray(fine[np.arange(STEPS)[:, None] * SUBSTEPS + np.arange(SUBSTEPS + 1)], jnp.float32)

    def step(state, height):
        position = jnp.stack([0.14 + 0.0 * height, height, 0.14 + 0.0 * height], axis=-1)[:, None]
        poses = Pose(position, jnp.broadcast_to(jnp.eye(3), (SUBSTEPS + 1, 1, 3, 3)))
        state, felt = mpm.step_with_touch(scene, state, poses, patches)
        return state, felt.force[:, 1]

    force = np.asarray(jax.jit(lambda s: jax.lax.scan(step, s, heights))(state)[1])
    weight = 1000.0 * EDGE**3 * 9.81
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(7, 4.6), sharex=True, height_ratios=(1, 2), layout="constrained"
    )
    above.plot(time, 100 * (bottom - FLOOR), color="0.3")
    above.axhline(100 * EDGE, color="0.7", lw=0.8)
    above.set_ylabel("plate above\nthe floor [cm]")
    below.plot(time[1:], force[:, 0], label="on the plate")
    below.plot(time[1:], force[:, 1], label="on the floor")
    below.axhline(-weight, color="0.7", lw=0.8)
    below.annotate("minus the weight", (0.0, -weight), va="bottom", fontsize=8, color="0.4")
    below.set(xlabel="time [s]", ylabel="force upwards [N]")
    below.legend(frameon=False)
    figure.savefig(out, dpi=130)
    print(f"largest force {force[:, 0].max():.1f} N; at the end {force[-10:].mean(0)} N, weight {weight:.2f} N")


if __name__ == "__main__":
    main(sys.argv[1])
