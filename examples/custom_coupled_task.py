"""Your own task on a robot that feels a soft body: an arm on motors flings a soft block. Comments explain it."""

import jax.numpy as jnp
import tyro

from rewax import struct
from rewax.agents.presets import SMALL
from rewax.agents.sapo import make_sapo
from rewax.envs.kit import CoupledTask, PointCloud, reset_noise
from rewax.physics import mpm, rigid
from rewax.physics.mpm import Grid, Material, NeoHookean, Wall, WallKind, Walls
from rewax.physics.shapes import fill_box
from rewax.testing import check_env
from rewax.training import TrainConfig, train_and_compare

SPACING = 0.025
FLOOR = 4 * SPACING  # nodes below a floor obey it: material may rest almost a cell below its position

# Geoms in contact with particles are at least one cell thick. Joint ranges are the limits of the robot.
ARM = f"""<mujoco><option gravity="0 -9.81 0"/><compiler autolimits="true"/><default>
  <geom contype="0" conaffinity="1" type="capsule" size="0.025" friction="0.5"/><joint axis="0 0 1" damping="0.05"/>
</default><worldbody><body pos="0.3 {FLOOR + 0.35} 0.2">
  <joint name="shoulder" range="-120 60"/><geom fromto="0 0 0 0 -0.14 0" mass="0.3" conaffinity="0"/>
  <body pos="0 -0.14 0"><joint name="elbow" range="-90 90"/><geom fromto="0 0 0 0 -0.14 0" size="0.03" mass="0.3"/>
  </body></body></worldbody><actuator>
  <motor joint="shoulder" ctrlrange="-3 3"/><motor joint="elbow" ctrlrange="-1 1"/>
</actuator>
</mujoco>"""


@struct.dataclass
class Fling(CoupledTask):
    """The reward is the block's velocity along x [m/s]."""

    def observe(self, physics):  # arrays of rank 2 are point clouds; all others form one vector
        x, v = physics.soft.x.mean(0), physics.soft.v.mean(0)
        joints = jnp.concatenate([physics.rigid.qpos, 0.1 * physics.rigid.qvel])
        touch = 0.1 * physics.touch.force[2]  # force of the particles on body 2, the forearm [N]
        return {
            "particle_q": self.observed(physics),
            "block": jnp.concatenate([x, v]),
            "joints": joints,
            "touch": touch,
        }

    def reward(self, physics):
        velocity = physics.soft.v[:, 0].mean()
        return velocity - 0.001 * jnp.sum(physics.action**2), {"velocity": velocity}


def make_fling() -> Fling:
    block = fill_box((0.4, FLOOR + 0.035, 0.2), (0.09, 0.07, 0.09), 0.5 * SPACING)  # two particles per cell and axis
    model = rigid.load(ARM, dt=2e-3)  # a multiple of the substep of the particles
    sides = Wall(position=2 * SPACING), Wall(position=0.4 - 2 * SPACING)
    scene = mpm.make_scene(
        grid=Grid(shape=(49, 17, 17), spacing=SPACING),
        dt=1e-3,
        material=Material(density=500.0, elasticity=NeoHookean(youngs_modulus=2e4, poissons_ratio=0.3)),
        particle_volume=0.09 * 0.07 * 0.09 / len(block),
        gravity=(0.0, -9.81, 0.0),  # that of the model
        colliders=rigid.colliders(model),  # its geoms with conaffinity
        walls=Walls(
            lower=(None, Wall(position=FLOOR, kind=WallKind.SEPARATING, friction=0.2), sides[0]),
            upper=(Wall(position=1.15), None, sides[1]),
        ),
        max_active_nodes=1024,  # nodes near particles; Status.INACTIVE_NODES reports when there are more
    )
    return Fling(
        model=model,
        scene=scene,
        rest_positions=block,
        noise=reset_noise((-0.005, 0.0, 0.0), (0.02, 0.0, 0.0)),
        cloud=PointCloud(num_points=32, stride=len(block) // 32),
        num_substeps=10,
        list_every=5,  # substeps per list of active nodes: the fastest particle moves less than one cell
        max_steps=40,
    )


def main(iterations: int = 60, seed: int = 0, check: bool = True) -> tuple[float, float]:
    env = make_fling()
    if check:
        check_env(env, check_full_episode=False)
    config = TrainConfig(num_iterations=iterations, run_dir=f"runs/fling-{seed}", seed=seed, eval_every=iterations)
    return train_and_compare(make_sapo(env, SMALL), env, config)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
