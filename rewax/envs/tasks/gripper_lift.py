"""GripperLift: two fingers grasp a soft block and lift it. The block exerts forces on the fingers, too.

Rewarped has no such task: here motors move the fingers, and the block pushes back. A policy that squeezes too
little, or pulls too hard, loses the block. The gradient of the height reaches the squeezing force through the contact
of the particles.
"""

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.coupled_task import CoupledPhysics, CoupledTask
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.rigid_task import load_asset
from rewax.envs.kit.soft_parts import lattice_box
from rewax.envs.kit.start_noise import reset_noise
from rewax.physics import mpm, rigid
from rewax.physics.mpm import Grid, Material, NeoHookean, Wall, WallKind, Walls
from rewax.sensors.camera import Camera
from rewax.sensors.framing import overlooking
from rewax.types import Array, Observation, Scalar

SIZE = (0.08, 0.08, 0.08)
"""Edges of the block [m]."""
FLOOR = 0.08
"""Height of the floor [m]. Material comes to rest up to one cell below it."""


@struct.dataclass
class GripperLift(CoupledTask):
    """The task; ``rewax.make("GripperLift", scale=...)`` builds it.

    Attributes:
      target: desired height of the center of the block [m].
      start_height: height of its center at rest [m].
      reach: weight of the distance between fingers and block in the reward [1/m].
      effort: weight of the squared norm of the action in the reward.
    """

    target: Scalar
    start_height: Scalar
    reach: Scalar
    effort: Scalar

    def observe(self, physics: CoupledPhysics) -> Observation:
        seen, touch = self.observed(physics), 0.1 * physics.touch.force[2:, :2].reshape(-1)
        joints = jnp.concatenate([physics.rigid.qpos, physics.rigid.qvel, touch])
        return {"particle_q": seen, "com_q": seen.mean(0), "joints": joints}

    def reward(self, physics: CoupledPhysics) -> tuple[Array, dict[str, Array]]:
        """1 - ((target - h) / (target - h0))^2 - reach gap - effort |a|^2.

        h is the mean height of the block [m] and h0 its value at rest. gap is the mean distance along x between the
        fingers and the faces of the block [m].
        """
        x = physics.soft.x
        height = x[:, 1].mean()
        lifted = 1.0 - ((self.target - height) / (self.target - self.start_height)) ** 2
        fingers = rigid.geom_poses(self.model, physics.rigid).position[1:, 0]
        thickness = self.model.parameters["geom_size"][1:, 0]
        gap = jnp.mean(jnp.maximum(jnp.abs(fingers - x[:, 0].mean()) - thickness - 0.5 * SIZE[0], 0.0))
        reward = lifted - self.reach * gap - self.effort * jnp.sum(physics.action**2)
        success = (jnp.abs(self.target - height) < 0.02).astype(height.dtype)
        return reward, {"height": height, "gap": gap, "success": success}

    @property
    def default_camera(self) -> Camera:
        return overlooking((0.19014966, 0.11, 0.20163015), 0.22, up=self.up)


def _gripper_lift(
    steps: Substeps, *, spacing: float, each: int, max_active_nodes: int, cloud: PointCloud, max_steps: int
) -> GripperLift:
    """A block of two particles per cell and axis; a substep of the robot is ``each`` substeps of the particles."""
    model = load_asset("gripper.xml", dt=steps.dt)
    counts = tuple(round(2 * edge / spacing) for edge in SIZE)
    middle = np.array([0.2, FLOOR + 0.5 * SIZE[1] - 0.5 * spacing, 0.2])
    shape = (round(0.4 / spacing) + 1, round(0.56 / spacing) + 1, round(0.4 / spacing) + 1)
    sides = Wall(position=2 * spacing), Wall(position=0.4 - 2 * spacing)
    scene = mpm.make_scene(
        grid=Grid(shape=shape, spacing=spacing),
        dt=steps.dt / each,
        material=Material(
            density=1000.0,
            elasticity=NeoHookean(youngs_modulus=2e4, poissons_ratio=0.3),
        ),
        particle_volume=float(np.prod(SIZE) / np.prod(counts)),
        gravity=(0.0, -9.81, 0.0),
        colliders=rigid.colliders(model),
        walls=Walls(
            lower=(sides[0], Wall(position=FLOOR, kind=WallKind.SEPARATING, friction=0.3), sides[0]),
            upper=(sides[1], None, sides[1]),
        ),
        max_active_nodes=max_active_nodes,
    )
    return GripperLift(
        model=model,
        scene=scene,
        rest_positions=lattice_box(middle, SIZE, counts),
        noise=reset_noise((-0.01, 0.0, -0.01), (0.01, 0.0, 0.01)),
        target=middle[1] + 0.12,
        start_height=middle[1],
        reach=10.0,
        effort=0.01,
        cloud=cloud,
        num_substeps=steps.num,
        list_every=steps.list_every,
        max_steps=max_steps,
    )


def paper(*, dt: float | None = None, num_substeps: int | None = None) -> GripperLift:
    """For an accelerator: cells of 1 cm, 4096 particles, six seconds. dt and num_substeps are the robot's."""
    return _gripper_lift(
        substeps(dt, num_substeps, Substeps(1e-3, 20, list_every=2)),
        spacing=0.01,
        each=4,
        max_active_nodes=8192,
        cloud=PointCloud(num_points=256, stride=16),
        max_steps=300,
    )


def small(*, dt: float | None = None, num_substeps: int | None = None) -> GripperLift:
    """For two cores: cells of 2 cm, 512 particles, 1.2 s. dt and num_substeps are the robot's."""
    return _gripper_lift(
        substeps(dt, num_substeps, Substeps(2e-3, 10, list_every=2)),
        spacing=0.02,
        each=2,
        max_active_nodes=1152,
        cloud=PointCloud(num_points=64, stride=8),
        max_steps=60,
    )
