"""PourBag: two hands empty a cloth bag of grains into a bowl.

The hands hold two opposite edges of the bag's rim. Grains are particles that touch the cloth from both sides.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.bowl import Bowl
from rewax.envs.kit.mixed_task import MixedTask
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.rewards import near, share_beyond
from rewax.envs.kit.set_points import Steered
from rewax.envs.kit.soft_parts import box_walls
from rewax.envs.kit.soft_task import SoftPhysics
from rewax.envs.kit.start_noise import reset_noise
from rewax.physics import coupling, mpm, thin
from rewax.physics.contact import Collider
from rewax.physics.mpm import DruckerPrager, Grid, Hencky, Material
from rewax.physics.numerics import Pose
from rewax.sensors.camera import Camera
from rewax.sensors.framing import overlooking
from rewax.types import Array, Observation, Scalar, Vector

WIDTH, DEPTH = 0.2, 0.08
"""Edge of the bag's square rim, and depth of the empty bag [m]."""
RADIUS, WALL = 0.13, 0.025
"""Radius of the bowl, and thickness of its wall [m]."""
START = (-0.28, 0.40, 0.0)
"""Middle of the hands at the beginning [m]."""
ROOM = ((-0.52, 0.0, -0.22), (0.26, 0.56, 0.22))
"""Lowest and highest coordinates of the room for grains [m]: walls, the floor, and no ceiling."""
SUCCESS = 0.9
"""Share of the grains that has to be in the bowl."""


@struct.dataclass
class PourBag(Steered, MixedTask):
    """The task; ``rewax.make("PourBag", scale=...)`` builds it.

    The five joints are the middle of the hands [m], the distance between them [m], and how far they are turned about
    z [rad]: at 0 both are level, at a positive angle the right hand is the lower one.

    Attributes:
      bowl: middle of the bowl's rim [m], shape (3,).
      rim: radius of the opening [m].
      scale: distance of a grain from the opening at which half of its reward is left [m].
      spilling: what a spilled grain costs, in rewards of a grain in the bowl.
    """

    bowl: Vector
    rim: Scalar
    scale: Scalar
    spilling: Scalar

    def pins(self, physics: SoftPhysics, joint_q: Array) -> Array:
        """Each hand is a bar along z: its vertices keep their z relative to the middle."""
        del physics
        x = self.rest_positions[self.num_particles :][self.scene.thin.topology.held.indices[:, 0]]
        offset = x - self.joint_start[:3]
        side, along = jnp.sign(offset[:, 0]), offset[:, 2]
        middle, half, angle = joint_q[:, None, :3], 0.5 * joint_q[:, 3:4] * side, joint_q[:, 4:5]
        return middle + jnp.stack(
            [half * jnp.cos(angle), -half * jnp.sin(angle), jnp.broadcast_to(along, half.shape)], axis=-1
        )

    def poses(self, joint_q: Array) -> Pose:
        """The bowl stands still."""
        shape = (len(joint_q), 1, 3)
        rotation = jnp.broadcast_to(jnp.eye(3, dtype=joint_q.dtype), (*shape, 3))
        return Pose(jnp.broadcast_to(self.bowl.astype(joint_q.dtype), shape), rotation)

    def first_joints(self, physics: SoftPhysics) -> Array:
        shift = physics.soft.thin.x.mean(0) - self.rest_positions[self.num_particles :].mean(0)
        return self.joint_start.at[:3].add(shift)

    def observe(self, physics: SoftPhysics) -> Observation:
        """Clouds of grains and bag relative to the bowl, the hands with their motion, and mean motion of the grains."""
        x, v = physics.soft.particles.x, physics.soft.particles.v
        q = physics.joint_q.at[:3].add(-self.bowl)
        vector = jnp.concatenate([q, physics.joint_qd, x.mean(0) - self.bowl, 0.5 * v.mean(0)])
        clouds = {"particle_q": self.observed(physics), "cloth_q": self.observed_cloth(physics)}
        return {**{name: cloud - self.bowl for name, cloud in clouds.items()}, "vector": vector}

    def reward(self, physics: SoftPhysics) -> tuple[Array, dict[str, Array]]:
        """Mean over the grains of (1 - s) / (1 + (d / scale)^2) - spilling s.

        d is the distance of a grain from the space below the bowl's opening; s, between 0 and 1, says whether it is
        spilled: beside the bowl and below its rim.
        """
        away = physics.soft.particles.x - self.bowl
        radius, height = jnp.sqrt(away[:, 0] ** 2 + away[:, 2] ** 2 + 1e-8), away[:, 1]
        beside, above = jnp.maximum(radius - self.rim, 0.0), jnp.maximum(height, 0.0)
        distance = jnp.sqrt(beside**2 + above**2 + 1e-8)
        spilled = share_beyond(radius, self.rim + 0.03, 0.01) * share_beyond(-height, 0.0, 0.01)
        reward = jnp.mean((1.0 - spilled) * near(distance, self.scale) - self.spilling * spilled)
        inside = jnp.mean(((radius < self.rim) & (height < 0.0)).astype(reward.dtype))
        metrics = {"inside": inside, "spilled": spilled.mean(), "success": (inside > SUCCESS).astype(reward.dtype)}
        return reward, metrics

    @property
    def camera(self) -> dict[str, Any]:
        return {"azimuth": 15.0, "elevation": 20.0}

    @property
    def default_camera(self) -> Camera:
        return overlooking((-0.15, 0.25, 0.0), 0.9, up=self.up)


def bag(cells: int) -> tuple[thin.ThinMesh, np.ndarray]:
    """A bag whose rim is level at the height 0 around the origin, and the vertices of the two edges that hands hold."""
    sheet = thin.sheet(WIDTH, WIDTH, cells, cells)
    x = sheet.vertices - [0.5 * WIDTH, 0.0, 0.5 * WIDTH]
    x[:, 1] = height_of_bag(x)
    return thin.ThinMesh(vertices=x, triangles=sheet.triangles), np.flatnonzero(np.abs(x[:, 0]) > 0.499 * WIDTH)


def height_of_bag(x: np.ndarray) -> np.ndarray:
    """Height of the empty bag at x and z of points, shape (n, 3) -> (n,): a flat bottom and four slopes."""
    outward = np.abs(x[:, [0, 2]]).max(axis=-1) / (0.5 * WIDTH)
    return DEPTH * (np.maximum(outward - 0.34, 0.0) / 0.66 - 1.0)


def grains_in_bag(spacing: float, gap: float) -> np.ndarray:
    """A lattice of points in the bag at least ``gap`` above the cloth and below the rim [m], shape (n, 3)."""
    level = np.arange(spacing / 2, 0.5 * WIDTH, spacing)
    level = np.concatenate([-level[::-1], level])
    height = np.arange(gap - DEPTH, 0.0, spacing)
    x = np.stack(np.meshgrid(level, height, level, indexing="ij"), axis=-1).reshape(-1, 3)
    slope = DEPTH / (0.66 * 0.5 * WIDTH)
    return x[x[:, 1] >= height_of_bag(x) + gap * np.sqrt(1.0 + slope**2) * (height_of_bag(x) > -DEPTH) ]


def _pour_bag(steps: Substeps, *, cells: int, spacing: float, law: dict[str, float], cloud: PointCloud, vertex_stride: int, max_steps: int) -> PourBag:
    mesh, held = bag(cells)
    cloth = thin.isotropic_cloth(youngs_modulus=3e4, poissons_ratio=0.3, thickness=1e-3, density=2000.0, damping=3e-4)
    bowl = np.array([0.0, RADIUS + 0.5 * WALL, 0.0])
    h = 2.0 * spacing
    lower, upper = np.array(ROOM[0]) - 2.5 * h, np.array(ROOM[1]) + 2.5 * h
    shape = tuple(int(n) for n in np.ceil((upper - lower) / h) + 1)
    scene = coupling.make_mixed_scene(
        particles=mpm.make_scene(
            grid=Grid(shape=shape, spacing=h, origin=tuple(lower)),
            dt=steps.dt,
            material=Material(
                density=100.0,
                elasticity=Hencky(youngs_modulus=4e3, poissons_ratio=0.3),
                plasticity=DruckerPrager(friction_angle=0.5, cohesion=0.0),
            ),
            particle_volume=spacing**3,
            colliders=(Collider(shape=Bowl(radius=RADIUS, thickness=WALL), friction=0.4, softness=np.log(10.0) / spacing),),
            walls=box_walls(0.0, (ROOM[0][0], ROOM[0][2]), (ROOM[1][0], ROOM[1][2])),
        ),
        thin=thin.make_scene(mesh=mesh, dt=steps.dt, cloth=cloth.replace(bending=1e-4), held=held, drag=1.0),
        contact=coupling.ParticleContact(thickness=spacing, friction=0.4, pairs_per_particle=9, every=5, **law),
        vertices=mesh.vertices,
    )
    grains = grains_in_bag(spacing, 0.9 * spacing)
    x, y, z = START
    return PourBag(
        scene=scene,
        rest_positions=np.concatenate([grains, mesh.vertices]) + START,
        noise=reset_noise((-0.03, 0.0, -0.03), (0.03, 0.0, 0.03)),
        joint_start=(x, y, z, WIDTH, 0.0),
        joint_lower=(-0.35, 0.36, -0.1, 0.6 * WIDTH, -0.3),
        joint_upper=(0.1, 0.5, 0.1, WIDTH, 2.4),
        joint_step=(0.02, 0.01, 0.01, 0.005, 0.1),
        rate=12.0,
        bowl=bowl,
        rim=RADIUS - 0.5 * WALL,
        scale=0.15,
        spilling=0.5,
        thickness=0.006,
        cloud=cloud,
        vertex_stride=vertex_stride,
        num_substeps=steps.num,
        max_steps=max_steps,
    )


def small(*, dt: float | None = None, num_substeps: int | None = None) -> PourBag:
    """Grains and triangles for two cores."""
    return _pour_bag(
        substeps(dt, num_substeps, Substeps(1.6e-3, 25)),
        cells=6,
        spacing=0.0175,
        law={"stiffness": 88.0, "damping": 0.01, "friction_damping": 0.01, "max_speed": 2.2},
        cloud=PointCloud(num_points=64, stride=3),
        vertex_stride=2,
        max_steps=40,
    )
