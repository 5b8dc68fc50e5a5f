"""RollingFlat: flatten a piece of dough with a rolling pin.

Scale ``paper`` is the task of the SAPO paper (PlasticineLab's rolling pin as Rewarped simulates it). Scale ``small``
learns within minutes on two cores: it has softer dough, a thicker pin that starts on the dough, longer motions per
control step and shorter episodes. ``docs/rolling_flat.md`` lists the differences and their reasons.
"""

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.soft_parts import box_walls, dough, random_box, turn_about_y
from rewax.envs.kit.soft_task import SoftPhysics, SoftTask
from rewax.envs.kit.start_noise import reset_noise
from rewax.physics import mpm
from rewax.physics.contact import Collider
from rewax.physics.mpm import Grid
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Capsule
from rewax.sensors.camera import Camera
from rewax.sensors.framing import overlooking
from rewax.types import Array, Observation, Vector

_Y_TO_Z = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))
"""Rotation that takes the axis of a capsule from y to z."""


@struct.dataclass
class RollingFlat(SoftTask):
    """The task; ``rewax.make("RollingFlat", scale=...)`` builds it.

    The joints of the pin are x, height y [m] and yaw about y [rad]. Actions are fractions of ``joint_step``.

    Attributes:
      pin_pivot: position of the pin for joint_q = 0 [m], shape (3,), and the center of its yaw.
      height_scale: unit of the height in the reward [m].
      height_origin: height that is 0 in the reward [m].
      observe_velocity: whether the last motion of the pin is observed, as joint_qd (static).
    """

    pin_pivot: Vector
    height_scale: Vector
    height_origin: Vector
    observe_velocity: bool = struct.static_field(default=False)

    def poses(self, joint_q: Array) -> Pose:
        x, y, yaw = joint_q[:, 0], joint_q[:, 1], joint_q[:, 2]
        position = self.pin_pivot + jnp.stack([x, y, jnp.zeros_like(yaw)], axis=-1)
        return Pose(position[:, None], turn_about_y(yaw)[:, None])

    def observe(self, physics: SoftPhysics) -> Observation:
        obs = super().observe(physics)
        return {**obs, "joint_qd": physics.joint_qd} if self.observe_velocity else obs

    def reward(self, physics: SoftPhysics) -> tuple[Array, dict[str, Array]]:
        """(1 / (1 + d))^2 (2 if d <= 0.33 else 1) - var(y), with d the mean scaled height of the observed particles."""
        y = self.observed(physics)[:, 1]
        d = (y.mean() - self.height_origin) / self.height_scale
        variance = y.var(ddof=1)
        reward = (1.0 / (1.0 + d)) ** 2 * jnp.where(d <= 0.33, 2.0, 1.0) - variance
        return reward, {"flatness": d, "height_variance": variance}

    @property
    def default_camera(self) -> Camera:
        return overlooking((0.4076329, 0.13050984, 0.49906272), 0.44976023, up=self.up)


def _pin(radius: float, half_length: float, *, offset: tuple[float, float, float], friction: float) -> Collider:
    return Collider(
        shape=Capsule(radius=radius, half_length=half_length),
        offset=offset,
        rotation=_Y_TO_Z,
        friction=friction,
        softness=666.0,
    )


def paper(
    *,
    youngs_modulus: float = 5000.0,
    yield_stress: float = 50.0,
    dt: float | None = None,
    num_substeps: int | None = None,
) -> RollingFlat:
    """The constants of Rewarped.

    Rewarped has 48 nodes along each axis. The 49th node lies behind the walls; with it particles have the bounds
    of Rewarped. The list of active nodes is long enough for dough that covers the whole table;
    ``Status.INACTIVE_NODES`` reports when it is too short (``benchmarks/active_nodes.py`` measures what is needed).
    """
    size, count = (0.3, 0.125, 0.3), 2592
    steps = substeps(dt, num_substeps, Substeps(5e-5, 40, list_every=5))
    scene = mpm.make_scene(
        grid=Grid(shape=(49, 49, 49), spacing=1.0 / 48),
        dt=steps.dt,
        material=dough(youngs_modulus, yield_stress),
        particle_volume=float(np.prod(size)) / count,
        gravity=(0.0, -90.0, 0.0),
        colliders=(
            _pin(0.03, 0.2, offset=(0.0, 0.0, 0.5), friction=0.9),
            _pin(0.012, 0.3, offset=(0.0, 0.0, 0.5), friction=0.9),
        ),
        walls=box_walls(floor=0.0625, lower=(0.0625, 0.0625), upper=(0.9375, 0.9375), ceiling=0.9375),
        max_active_nodes=10752,  # a sheet over the table, at most one cell thick, touches 46 * 5 * 46 nodes
        reach=0.5,
    )
    return RollingFlat(
        scene=scene,
        rest_positions=random_box((0.5, 0.15, 0.5), size, count),
        pin_pivot=jnp.zeros(3),
        joint_start=[0.5, 0.2875, 0.0],
        joint_lower=[0.12, 0.1225, -0.66 * np.pi],
        joint_upper=[0.88, 0.3725, 0.66 * np.pi],
        joint_step=[0.01, 0.01, np.pi / 60],
        noise=reset_noise((-0.1, 0.0, -0.1), (0.1, 0.05, 0.1), 0.1),
        height_scale=0.125,
        height_origin=0.0,
        num_substeps=steps.num,
        max_steps=300,
        exact_limits=False,
        cloud=PointCloud(num_points=250, stride=10),
        list_every=steps.list_every,
    )


def small(
    *,
    youngs_modulus: float = 750.0,
    yield_stress: float = 15.0,
    dt: float | None = None,
    num_substeps: int | None = None,
) -> RollingFlat:
    """A task that learns within minutes on two cores; ``docs/rolling_flat.md`` has the reason for each difference."""
    size, count, floor, spacing, radius = (0.3, 0.125, 0.3), 256, 0.0625, 1.0 / 24, 0.05
    top = floor + size[1]
    steps = substeps(dt, num_substeps, Substeps(7e-4, 10))
    scene = mpm.make_scene(
        grid=Grid(shape=(22, 9, 19), spacing=spacing, origin=(1.5 * spacing, 0.0, 3.0 * spacing)),
        dt=steps.dt,
        material=dough(youngs_modulus, yield_stress),
        particle_volume=float(np.prod(size)) / count,
        gravity=(0.0, -90.0, 0.0),
        colliders=(_pin(radius, 0.25, offset=(0.0, 0.0, 0.0), friction=0.9),),
        walls=box_walls(floor=floor, lower=(0.15, 0.25), upper=(0.85, 0.75)),
        max_active_nodes=1664,  # benchmarks/active_nodes.py needed at most 1416
    )
    return RollingFlat(
        scene=scene,
        rest_positions=random_box((0.5, floor + 0.5 * size[1], 0.5), size, count),
        pin_pivot=[0.0, 0.0, 0.5],
        joint_start=[0.5, top + radius, 0.0],
        joint_lower=[0.15, floor + radius + 0.03, -0.66 * np.pi],
        joint_upper=[0.85, top + radius + 0.05, 0.66 * np.pi],
        joint_step=[0.02, 0.004, np.pi / 60],
        noise=reset_noise((-0.1, 0.0, 0.0), (0.1, 0.0, 0.0)),
        height_scale=size[1],
        height_origin=floor,
        num_substeps=steps.num,
        max_steps=60,
        cloud=PointCloud(num_points=64, stride=4),
        observe_velocity=True,
    )
