"""What cameras see of tasks: depth, bodies and normals of some, and the default cameras of all.

python benchmarks/camera_pictures.py --out docs/pictures/cameras.jpg --defaults docs/pictures/default_cameras.jpg
"""

from pathlib import Path
from typing import Annotated

import jax
import matplotlib
import numpy as np
import tyro

import rewax
from rewax.envs.named_sensors import default_camera
from rewax.sensors import Camera, View

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TASKS = {"GripperLift": 1.0, "HandFlip": 1.0, "AntRun": 1.4}
"""Tasks, and the camera's distance in sizes of what is seen."""


def seen(name: str, distance: float) -> tuple[View, Camera]:
    """A picture of the task's beginning from above the front."""
    env = rewax.make(name, scale="small")
    physics = jax.jit(env.reset)(jax.random.key(0)).physics
    up = np.asarray(env.up)
    world = env.world(physics, up)
    centers = [b.center for b in world.balls] or [world.bodies.position[1:]]
    points = np.concatenate([np.asarray(c) for c in centers])
    middle, size = points.mean(axis=0), np.ptp(points, axis=0).max() + (0.1 if world.balls else 0.6)
    front = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.5 else np.array([0.0, -1.0, 0.0])
    eye = middle + distance * size * (1.3 * front + 1.1 * up + 0.4 * np.cross(up, front))
    away = float(np.linalg.norm(eye - middle))
    camera = Camera.look_at(
        middle, eye=eye, up=up, near=max(away - size, 0.1 * away), far=away + 2 * size, height=256, width=256
    )
    return jax.jit(lambda physics: camera.view(env.world(physics, up)))(physics), camera


def defaults(out: Path) -> None:
    """Draw depth and bodies at the beginning of every task, as its default camera sees them."""
    names = rewax.list_envs()
    figure, axes = plt.subplots(-(-len(names) // 4), 4, figsize=(11.0, 1.6 * -(-len(names) // 4)))
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, name in zip(axes.flat, names, strict=False):
        env = rewax.make(name, scale="small")
        camera, up = default_camera(env, 160), np.asarray(env.up)
        physics = jax.jit(env.reset)(jax.random.key(0)).physics
        view = jax.jit(lambda physics, env=env, up=up, camera=camera: camera.view(env.world(physics, up)))(physics)
        label = np.asarray(view.label)
        near = 1.0 - (np.asarray(view.depth) - camera.near) / (camera.far - camera.near)
        bodies = plt.get_cmap("tab20")(label % 20)[..., :3] * (label >= 0)[..., None]
        axis.imshow(np.concatenate([np.repeat(near[..., None], 3, axis=-1).clip(0.0, 1.0), bodies], axis=1))
        axis.set_title(name, fontsize=8, pad=2)
    figure.tight_layout(pad=0.3)
    figure.savefig(out, dpi=90, pil_kwargs={"quality": 85})


def some(out: Path) -> None:
    """Draw depth, bodies and normals of a few tasks."""
    figure, axes = plt.subplots(len(TASKS), 3, figsize=(7.5, 2.5 * len(TASKS)))
    for row, (name, distance) in zip(axes, TASKS.items(), strict=True):
        view, camera = seen(name, distance)
        depth, label = np.asarray(view.depth), np.asarray(view.label)
        row[0].imshow(np.where(depth < camera.far, depth, np.nan))
        row[1].imshow(np.where(label >= 0, label % 20, np.nan), cmap="tab20", vmin=0, vmax=19)
        row[2].imshow(0.5 * np.asarray(view.normal) + 0.5)
        row[0].set_ylabel(name)
    for title, axis in zip(("depth", "bodies", "normals"), axes[0], strict=True):
        axis.set_title(title)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    figure.tight_layout()
    figure.savefig(out, dpi=80, pil_kwargs={"quality": 85})


def main(out: Path | None = None, defaults_out: Annotated[Path | None, tyro.conf.arg(name="defaults")] = None) -> None:
    """Write one picture or both."""
    if out is not None:
        some(out)
    if defaults_out is not None:
        defaults(defaults_out)


if __name__ == "__main__":
    tyro.cli(main)
