"""Your own task on particles: a paddle pushes sand onto a mark. Comments explain what you need to know."""

import jax.numpy as jnp
import numpy as np
import tyro

from rewax import struct
from rewax.agents.presets import SMALL
from rewax.agents.sapo import make_sapo
from rewax.envs.kit import PointCloud, SoftTask, reset_noise
from rewax.physics import mpm
from rewax.physics.contact import Collider
from rewax.physics.mpm import DruckerPrager, Grid, Hencky, Material, Wall, WallKind, Walls
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Box, fill_box
from rewax.testing import check_env
from rewax.training import TrainConfig, train_and_compare
from rewax.types import Array

SPACING = 0.025
FLOOR = 4 * SPACING  # nodes below a floor obey it: material may rest almost a cell below its position


@struct.dataclass
class PushSand(SoftTask):
    """The reward is 1 - distance / 0.2 m, with the mean horizontal distance of the sand from the mark."""

    mark: Array

    def poses(self, joint_q):  # (n, 2) -> poses of the one body that carries the colliders, (n, 1, 3), (n, 1, 3, 3)
        x, z = joint_q[:, 0], joint_q[:, 1]
        position = jnp.stack([x, jnp.full_like(x, FLOOR + 0.05), z], axis=-1)
        return Pose(position[:, None], jnp.broadcast_to(jnp.eye(3, dtype=x.dtype), (len(x), 1, 3, 3)))

    def observe(self, physics):  # arrays of rank 2 are point clouds; all others form one vector
        return {**super().observe(physics), "joint_qd": physics.joint_qd}

    def reward(self, physics):
        away = (physics.soft.x - self.mark)[:, jnp.array([0, 2])]
        distance = jnp.mean(
            jnp.sqrt(jnp.sum(away**2, axis=-1) + 1e-6)
        )  # smooth: the derivative of a square root is infinite at 0
        return 1.0 - distance / 0.2, {"distance": distance}

    def render_shapes(self, physics):  # a list of drawings, see rewax.viz.shapes: tools, and a marker for the target
        return [*super().render_shapes(physics), {"kind": "sphere", "center": self.mark, "radius": 0.015}]


def make_push_sand() -> PushSand:
    sand = fill_box((0.25, FLOOR + 0.025, 0.3), (0.1, 0.07, 0.1), 0.5 * SPACING)  # two particles per cell and axis
    sides = Wall(position=2 * SPACING), Wall(position=0.6 - 2 * SPACING)
    floor = Wall(position=FLOOR, kind=WallKind.SEPARATING, friction=0.5)
    scene = mpm.make_scene(
        grid=Grid(shape=(25, 13, 25), spacing=SPACING),
        dt=1.5e-3,  # an error names the largest stable dt if this one is too long
        material=Material(
            density=1500.0,
            elasticity=Hencky(youngs_modulus=5e4, poissons_ratio=0.2),
            plasticity=DruckerPrager(friction_angle=np.radians(30.0)),
        ),
        particle_volume=0.1 * 0.07 * 0.1 / len(sand),
        colliders=(
            Collider(
                shape=Box(half_size=(0.025, 0.06, 0.06)),  # at least a cell thick, or sand passes through
                friction=0.3,
            ),
        ),
        walls=Walls(lower=(sides[0], floor, sides[0]), upper=(sides[1], None, sides[1])),
        max_active_nodes=2048,  # nodes near particles; Status.INACTIVE_NODES reports when there are more
    )
    return PushSand(
        scene=scene,
        rest_positions=sand,
        noise=reset_noise((0.0, 0.0, -0.05), (0.0, 0.0, 0.05)),
        joint_start=(0.165, 0.3),  # the paddle touches the sand: far from it, the gradient would be zero
        joint_lower=(0.08, 0.15),
        joint_upper=(0.5, 0.45),
        joint_step=(0.01, 0.01),
        mark=(0.42, FLOOR, 0.3),
        cloud=PointCloud(num_points=64, stride=len(sand) // 64),
        num_substeps=12,
        max_steps=60,
    )


def main(iterations: int = 60, seed: int = 0, check: bool = True) -> tuple[float, float]:
    env = make_push_sand()
    if check:
        check_env(env, check_full_episode=False)
    config = TrainConfig(num_iterations=iterations, run_dir=f"runs/sand-{seed}", seed=seed, eval_every=iterations)
    return train_and_compare(make_sapo(env, SMALL), env, config)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
