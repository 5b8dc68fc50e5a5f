"""FluidMove: carry water in an open container to a target, without spilling it.

At scale ``paper`` this is the task of the SAPO paper (SoftGym's transport as Rewarped simulates it): a container of
five boxes moves along x, y and z, at most at half a metre per second. Scale ``small`` has less water and a coarser
grid, and its terms for distance and spilling have derivatives that are useful for learning.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.appearance import MARKER
from rewax.envs.kit.options import Substeps, number_option, substeps
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.soft_body import Soft
from rewax.envs.kit.soft_parts import box_walls, lattice_box, random_box, water
from rewax.envs.kit.soft_task import SoftPhysics, SoftTask
from rewax.envs.kit.start_noise import round_unit
from rewax.physics import mpm
from rewax.physics.contact import Collider
from rewax.physics.mpm import Grid, MPMScene, WallKind
from rewax.physics.numerics import Pose
from rewax.physics.numerics.checks import Legal
from rewax.physics.shapes import Box
from rewax.sensors.camera import Camera
from rewax.sensors.framing import overlooking
from rewax.types import Array, Key, Observation, PyTree, Scalar, Vector

REFERENCE = {
    "grid": 48,
    "dt": 5e-4,
    "num_substeps": 40,
    "max_steps": 300,
    "gravity": -9.8,
    "friction": 0.5,
    "softness": 666.0,
    "youngs_modulus": 1e5,
    "num_particles": 2880,
    "water_size": (0.16, 0.094, 0.20),
    "center": (0.5, 0.15, 0.5),
    "inner_size": (0.18, 0.16, 0.22),
    "thickness": 0.05,
    "joint_lower": (0.18, 0.16, 0.22),
    "joint_upper": (0.82, 0.84, 0.78),
    "joint_step": 0.01,
    "target_lower": (-0.2, 0.0, -0.2),
    "target_upper": (0.2, 0.3, 0.2),
    "spill_width": 1e-5,
    "distance_scale": 1.0,
    "num_observed": 250,
    "stride": 11,
}
"""Xing, Luk and Oh 2025 and Rewarped; lengths in m, times in s, moduli in Pa."""


@struct.dataclass
class FluidMove(SoftTask):
    """The task; ``rewax.make("FluidMove", scale=...)`` builds it.

    The joints are the position of the container [m]. ``physics.task`` is the target [m], shape (3,).

    Attributes:
      target_lower, target_upper: range of the target relative to the start of the container [m], shape (3,).
      outer: half edges of the box, centered at the container, outside of which water is spilt [m], shape (3,).
      spill_width: width of the sigmoid of the distance outside this box [m]. Rewarped has 1e-5: the derivative is
        then zero almost everywhere.
      distance_scale: unit of the distance to the target [m]. Rewarped has 1, for which the reward is nearly flat.
      relative: whether water and target are observed relative to the container. Then the position of the container and
        the mean of the water are not observed (static).
    """

    target_lower: Vector
    target_upper: Vector
    outer: Vector
    spill_width: Scalar
    distance_scale: Scalar
    relative: bool = struct.static_field(default=False)

    def start(self, positions: Array, key: Key) -> tuple[Soft, PyTree]:
        shift = jax.random.uniform(key, (3,), minval=self.target_lower, maxval=self.target_upper)
        shift = round_unit(shift, jnp.maximum(jnp.abs(self.target_lower), jnp.abs(self.target_upper)))
        return self.at_rest(positions), self.joint_start + shift

    def poses(self, joint_q: Array) -> Pose:
        return Pose(joint_q[:, None], jnp.broadcast_to(jnp.eye(3, dtype=joint_q.dtype), (len(joint_q), 1, 3, 3)))

    def observe(self, physics: SoftPhysics) -> Observation:
        obs = {**super().observe(physics), "target_q": physics.task - self._origin(physics)}
        if self.relative:
            # Omitted: the centre of mass oscillates and destabilises the policy; the absolute position reveals the
            # start.
            del obs["com_q"], obs["joint_q"]
        return obs

    def points(self, physics: SoftPhysics) -> tuple[Array, Array]:
        return physics.soft.x - self._origin(physics), physics.soft.v

    def _origin(self, physics: SoftPhysics) -> Array:
        return physics.joint_q if self.relative else jnp.zeros_like(physics.joint_q)

    def reward(self, physics: SoftPhysics) -> tuple[Array, dict[str, Array]]:
        """0.1 (1 / (1 + (d / distance_scale)^2))^2 (2 if d <= 0.02 else 1) - spill.

        d is the distance between container and target [m]. The spill of a particle is the largest component of
        sigmoid((|x - container| - outer) / spill_width); the reward has its mean over the observed particles.
        """
        square = jnp.sum((physics.joint_q - physics.task) ** 2)
        far = jnp.abs(self.cloud.pick(physics.soft.x) - physics.joint_q) - self.outer
        spill = jnp.mean(jnp.max(jax.nn.sigmoid(far / self.spill_width), axis=-1))
        near = (1.0 / (1.0 + square / self.distance_scale**2)) ** 2
        reward = 0.1 * near * jnp.where(square <= 0.02**2, 2.0, 1.0) - spill
        distance = jnp.sqrt(jax.lax.stop_gradient(square))
        success = (distance <= 0.02) & (jnp.mean(jnp.max(far, axis=-1) > 0.0) <= 0.05)
        return reward, {"distance": distance, "spill": spill, "success": success.astype(spill.dtype)}

    def render_shapes(self, physics: SoftPhysics) -> list[dict[str, Any]]:
        marker = {"kind": "sphere", "center": physics.task, "radius": 0.02, "color": MARKER}
        return [*({**wall, "opacity": 0.3} for wall in super().render_shapes(physics)), marker]

    @property
    def camera(self) -> dict[str, Any]:
        return {"elevation": 28.0}

    @property
    def default_camera(self) -> Camera:
        # All places of the container between its start and the targets.
        return overlooking((0.5, 0.37, 0.5), 0.85, up=self.up)


def container(
    inner: tuple[float, float, float], thickness: float, *, friction: float, softness: float
) -> tuple[Collider, ...]:
    """Bottom and four walls of a box that is open at the top. The origin is the center of its inside."""
    (x, y, z), t = inner, thickness
    bottom = ((0.0, -(y + t) / 2, 0.0), (x / 2 + t, t / 2, z / 2 + t))
    along_x = [((side * (x + t) / 2, -t / 2, 0.0), (t / 2, (y + t) / 2, z / 2 + t)) for side in (-1, 1)]
    along_z = [((0.0, -t / 2, side * (z + t) / 2), (x / 2 + t, (y + t) / 2, t / 2)) for side in (-1, 1)]
    return tuple(
        Collider(
            shape=Box(half_size=half_size),
            offset=offset,
            friction=friction,
            softness=softness,
        )
        for offset, half_size in (bottom, *along_x, *along_z)
    )


def _outer(inner: tuple[float, float, float], thickness: float) -> Array:
    """Half edges of the box outside which water is spilt. As in Rewarped, its top is half a wall above the rim."""
    length, height, width = inner
    return jnp.asarray([length / 2 + thickness, (height + thickness) / 2, width / 2 + thickness])


def _fluid_move(
    scene: MPMScene, steps: Substeps, start: tuple[float, ...], rest_positions: Array, thickness: float, **changes: Any
) -> FluidMove:
    r = REFERENCE
    options = {
        "max_steps": r["max_steps"],
        "joint_step": jnp.full(3, r["joint_step"]),
        "spill_width": r["spill_width"],
        "distance_scale": r["distance_scale"],
        "target_lower": r["target_lower"],
        "target_upper": r["target_upper"],
        **changes,
    }
    return FluidMove(
        scene=scene,
        rest_positions=rest_positions,
        joint_start=start,
        joint_lower=r["joint_lower"],
        joint_upper=r["joint_upper"],
        outer=_outer(r["inner_size"], thickness),
        num_substeps=steps.num,
        list_every=steps.list_every,
        **options,
    )


def paper(
    *,
    youngs_modulus: float = REFERENCE["youngs_modulus"],
    dt: float | None = None,
    num_substeps: int | None = None,
) -> FluidMove:
    """The constants of Rewarped. The container starts below its lower limit, and the first step lifts it there."""
    r = REFERENCE
    steps = substeps(dt, num_substeps, Substeps(r["dt"], r["num_substeps"], list_every=5))
    scene = mpm.make_scene(
        grid=Grid(shape=(49, 49, 49), spacing=1.0 / r["grid"]),
        dt=steps.dt,
        material=water(youngs_modulus),
        particle_volume=float(np.prod(r["water_size"])) / r["num_particles"],
        gravity=(0.0, r["gravity"], 0.0),
        colliders=container(r["inner_size"], r["thickness"], friction=r["friction"], softness=r["softness"]),
        walls=box_walls(0.0625, (0.0625, 0.0625), (0.9375, 0.9375), ceiling=0.9375, floor_kind=WallKind.SEPARATING),
        max_active_nodes=10752,
        reach=0.5,
    )
    return _fluid_move(
        scene,
        steps,
        r["center"],
        random_box(r["center"], r["water_size"], r["num_particles"]),
        r["thickness"],
        cloud=PointCloud(num_points=r["num_observed"], stride=r["stride"]),
        exact_limits=False,
    )


def small(
    *,
    youngs_modulus: float = 2.5e4,
    dt: float | None = None,
    num_substeps: int | None = None,
    thickness: float = 0.0625,
) -> FluidMove:
    """A task that learns within minutes on two cores; ``docs/soft_tasks.md`` has the reason for each difference."""
    r, spacing, start = REFERENCE, 1.0 / 32, (0.5, 0.25, 0.5)
    steps = substeps(dt, num_substeps, Substeps(2e-3, 10, list_every=5))
    thickness = number_option("thickness", thickness, Legal(0.0, 0.2), remedy="give the thickness of the walls in m")
    size, counts = np.asarray(r["water_size"]), (8, 5, 10)
    center = np.asarray(start) - [0.0, 0.5 * (r["inner_size"][1] - size[1]), 0.0]
    scene = mpm.make_scene(
        grid=Grid(shape=(33, 33, 33), spacing=spacing),
        dt=steps.dt,
        material=water(youngs_modulus),
        particle_volume=float(np.prod(size)) / np.prod(counts),
        gravity=(0.0, r["gravity"], 0.0),
        colliders=container(r["inner_size"], thickness, friction=r["friction"], softness=r["softness"]),
        walls=box_walls(0.0625, (0.0625, 0.0625), (0.9375, 0.9375), ceiling=0.9375, floor_kind=WallKind.SEPARATING),
        max_active_nodes=4608,
    )
    return _fluid_move(
        scene,
        steps,
        start,
        lattice_box(center, size, counts),
        thickness,
        cloud=PointCloud(num_points=80, stride=5),
        max_steps=80,
        joint_step=jnp.full(3, 0.01),
        spill_width=0.005,
        distance_scale=0.3,
        relative=True,
    )
