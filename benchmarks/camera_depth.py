"""Depth of ``rewax.sensors.Camera`` beside MuJoCo's own renderer and MuJoCo's rays, on six scenes.

    MUJOCO_GL=egl PYTHONPATH=.:tests python benchmarks/camera_depth.py [--picture camera_depth.png]

The renderer rounds curved geoms to triangles (here 256 slices) and depth to 24 bits between its clipping planes; at an
outline a pixel may see one thing or the other. Shares are of the pixels where either shows a body.
"""

import argparse

import jax
import mujoco
import numpy as np
from camera_scenes import EYE, SCENES, TARGET, UP, mjcf, ray_depth

from rewax.physics import rigid
from rewax.sensors import Camera, World
from rewax.sensors.robots import with_robot

HEIGHT, WIDTH, NEAR, FAR = 240, 320, 0.3, 5.0


def rendered_depth(model: mujoco.MjModel) -> np.ndarray:
    """Depth by MuJoCo's renderer [m], shape (HEIGHT, WIDTH), at most ``FAR``."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.enable_depth_rendering()
        renderer.update_scene(data, camera="eye")
        return np.minimum(renderer.render(), FAR)


def agreement(ours: np.ndarray, theirs: np.ndarray) -> tuple[float, float]:
    """Of the pixels where either shows a body: the share within 1 mm, and the median error [m]."""
    error = np.abs(ours - theirs)[(ours < FAR) | (theirs < FAR)]
    return float((error < 1e-3).mean()), float(np.median(error))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--picture", help="write the six pictures, ours above MuJoCo's, to this file")
    picture = parser.parse_args().picture
    camera = Camera.look_at(TARGET, eye=EYE, up=UP, near=NEAR, far=FAR, height=HEIGHT, width=WIDTH)
    pairs = []
    print("| scene | pixels that show a body | within 1 mm of the renderer | median error | within 1 mm of the rays |")
    print("|---|---|---|---|---|")
    for scene in SCENES:
        model = rigid.load(mjcf(scene), dt=1e-3)
        ours = np.asarray(jax.jit(camera.depth)(with_robot(World(), model, rigid.initial_state(model))))
        theirs = rendered_depth(model.static.mj)
        x, y = camera._slopes()
        ahead = np.stack([x, y, -np.ones_like(x)], -1) @ np.asarray(camera.rotation).T
        rays = ray_depth(model.static.mj, ahead, -np.asarray(camera.rotation)[:, 2], FAR).reshape(HEIGHT, WIDTH)
        share, error = agreement(ours, theirs)
        print(
            f"| {scene} | {(theirs < FAR).mean():.1%} | {share:.2%} | {error * 1e3:.3f} mm | "
            f"{agreement(ours, rays)[0]:.2%} |"
        )
        pairs.append((ours, theirs))
    if picture:
        draw(pairs, picture)


def draw(pairs: list[tuple[np.ndarray, np.ndarray]], path: str) -> None:
    """Write pictures side by side."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(pairs), figsize=(2.4 * len(pairs), 4))
    for column, (pair, scene) in enumerate(zip(pairs, SCENES, strict=True)):
        for row, depth in enumerate(pair):
            axes[row, column].imshow(np.where(depth < FAR, depth, np.nan), vmin=0.8, vmax=2.2)
            axes[row, column].set(xticks=[], yticks=[])
        axes[0, column].set_title(scene, fontsize=9)
    axes[0, 0].set_ylabel("rewax")
    axes[1, 0].set_ylabel("MuJoCo")
    figure.tight_layout()
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
