"""PourBag: two hands empty a cloth bag of grains into a bowl.

The hands hold two opposite edges of the bag's rim. Grains are particles that push the cloth and are held by it.
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
from rewax.physics.coupling import MixedScene, ParticleContact
from rewax.physics.mpm import DruckerPrager, Grid, Hencky, Material
from rewax.physics.numerics import Pose
from rewax.sensors.camera import Camera
from rewax.sensors.framing import overlooking
from rewax.types import Array, Observation, Scalar, Vector

WIDTH, DEPTH, BOTTOM = 0.2, 0.08, 0.34
"""Edge of the bag's square rim and depth of the empty bag [m]; edge of its flat bottom over that of the rim."""
RIM, RADIUS, WALL = 0.1425, 0.1475, 0.06
"""Height of the bowl's rim, radius of the bowl, and thickness of its wall [m]: thick, so that no grain passes."""
START = (-0.28, 0.4, 0.0)
"""Middle of the hands at the beginning [m]."""
ROOM = ((-0.52, 0.0, -0.22), (0.26, 0.6, 0.22))
"""Lowest and highest coordinates of the room for grains [m]: a floor, walls at the sides, no ceiling."""
SUCCESS = 0.9
"""Share of the grains that has to be in the bowl."""


@struct.dataclass
class PourBag(Steered, MixedTask):
    """The task; ``rewax.make("PourBag", scale=...)`` builds it.

    The five joints are the middle of the hands [m], the distance between them [m], and how far both are turned about z
    [rad]: at 0 they are level, at a positive angle the right one is lower. The bag hangs too high to touch the bowl.

    Attributes:
      bowl: middle of the bowl's rim [m], shape (3,).
      rim: radius of the opening [m].
      scale: distance of a grain from the opening at which half of its reward is left [m].
      spilling: cost of a spilled grain, over the reward of a grain in the bowl.
    """

    bowl: Vector
    rim: Scalar
    scale: Scalar
    spilling: Scalar

    def pins(self, physics: SoftPhysics, joint_q: Array) -> Array:
        """Each hand is a bar along z."""
        del physics
        held = self.thin_scene.topology.held.indices[:, 0]
        offset = self.rest_positions[self.num_particles :][held] - self.joint_start[:3]
        half, angle = 0.5 * joint_q[:, 3:4] * jnp.sign(offset[:, 0]), joint_q[:, 4:]
        along = jnp.broadcast_to(offset[:, 2], half.shape)
        return joint_q[:, None, :3] + jnp.stack([half * jnp.cos(angle), -half * jnp.sin(angle), along], axis=-1)

    def poses(self, joint_q: Array) -> Pose:
        """The bowl stands still."""
        position = jnp.broadcast_to(self.bowl.astype(joint_q.dtype), (len(joint_q), 1, 3))
        return Pose(position, jnp.broadcast_to(jnp.eye(3, dtype=joint_q.dtype), (*position.shape, 3)))

    def first_joints(self, physics: SoftPhysics) -> Array:
        shift = self.vertices(physics)[0] - self.rest_positions[self.num_particles]
        return self.joint_start.at[:3].add(shift)

    def points(self, physics: SoftPhysics) -> tuple[Array, Array]:
        x, v = super().points(physics)
        return x - self.bowl, v

    def observe(self, physics: SoftPhysics) -> Observation:
        """Clouds of grains and bag, and a vector of shape (21,); positions are relative to the bowl.

        The vector holds the joints, their velocities, their set points relative to them, and the grains' mean position
        and half of their mean velocity.
        """
        x, v = self.points(physics)
        hands = physics.joint_q.at[:3].add(-self.bowl)
        joints = [hands, physics.joint_qd, self.ahead(physics)]
        vector = jnp.concatenate([*joints, x.mean(0), 0.5 * v.mean(0)])
        cloth = self.observed_cloth(physics) - self.bowl
        return {"particle_q": self.observed(physics), "cloth_q": cloth, "vector": vector}

    def reward(self, physics: SoftPhysics) -> tuple[Array, dict[str, Array]]:
        """Mean over the grains of (1 - s) / (1 + (d / scale)^2) - spilling s.

        d is the distance of a grain from the cylinder below the bowl's opening. s rises from 0 to 1 where a grain is
        spilled: outside the bowl and below its rim.
        """
        away = self.points(physics)[0]
        radius, height = jnp.sqrt(away[:, 0] ** 2 + away[:, 2] ** 2 + 1e-8), away[:, 1]
        beside, above = jnp.maximum(radius - self.rim, 0.0), jnp.maximum(height, 0.0)
        distance = jnp.sqrt(beside**2 + above**2 + 1e-8)
        spilled = share_beyond(radius, self.rim + 0.5 * WALL, 0.01) * share_beyond(-height, 0.0, 0.01)
        reward = jnp.mean((1.0 - spilled) * near(distance, self.scale) - self.spilling * spilled)
        inside = jnp.mean(((radius < self.rim) & (height < 0.0)).astype(reward.dtype))
        success = (inside > SUCCESS).astype(reward.dtype)
        return reward, {"inside": inside, "spilled": spilled.mean(), "success": success}

    @property
    def camera(self) -> dict[str, Any]:
        return {"azimuth": 15.0, "elevation": 20.0}

    @property
    def default_camera(self) -> Camera:
        return overlooking((-0.13, 0.2, 0.0), 0.9, up=self.up)


def bag(cells: int) -> tuple[thin.ThinMesh, np.ndarray]:
    """A bag whose rim is level at height 0 around the origin, and the vertices of the two edges that the hands hold."""
    sheet = thin.sheet(WIDTH, WIDTH, cells, cells)
    x = sheet.vertices - [0.5 * WIDTH, 0.0, 0.5 * WIDTH]
    x[:, 1] = bag_height(x)
    return thin.ThinMesh(vertices=x, triangles=sheet.triangles), np.flatnonzero(np.abs(x[:, 0]) > 0.499 * WIDTH)


def bag_height(x: np.ndarray) -> np.ndarray:
    """Height of the empty bag below or above points [m], shape (n, 3) -> (n,): a flat bottom and four slopes."""
    outwards = np.abs(x[:, [0, 2]]).max(axis=-1) / (0.5 * WIDTH)
    return DEPTH * (np.maximum(outwards - BOTTOM, 0.0) / (1.0 - BOTTOM) - 1.0)


def grains_in_bag(spacing: float, gap: float, top: float = 0.0) -> np.ndarray:
    """A lattice of points below the height ``top``, at least ``gap`` [m] away from the cloth, shape (n, 3)."""
    half = np.arange(0.5 * spacing, 0.5 * WIDTH, spacing)
    level, height = np.concatenate([-half[::-1], half]), np.arange(gap - DEPTH, top, spacing)
    x = np.stack(np.meshgrid(level, height, level, indexing="ij"), axis=-1).reshape(-1, 3)
    slope = DEPTH / (0.5 * (1.0 - BOTTOM) * WIDTH)
    steep = gap * np.hypot(1.0, slope)  # vertical distance from a slope
    return x[(x[:, 1] > bag_height(x) + steep) | (bag_height(x) == -DEPTH)]


def bag_of_grains(
    dt: float, mesh: thin.ThinMesh, held: np.ndarray, spacing: float, stiffness: float, max_active_nodes: int
) -> MixedScene:
    """The scene: a heavy, soft cloth of 2 kg/m^2 and light grains of 100 kg/m^3.

    So cloth and contact allow long substeps, and the contact stops grains of up to 2.2 m/s.

    Args:
      dt: duration of a substep [s].
      mesh, held: the bag and its held vertices.
      spacing: of the particles, and thickness of their contact with the cloth [m]. A cell of the grid is twice as long.
      stiffness: force of that contact per depth [N/m].
      max_active_nodes: length of the list of the grid's nodes near grains.
    """
    cell = 2.0 * spacing
    lower, upper = np.array(ROOM[0]) - 2.5 * cell, np.array(ROOM[1]) + 2.5 * cell
    nx, ny, nz = (int(n) for n in np.ceil((upper - lower) / cell) + 1)
    bowl = Collider(shape=Bowl(radius=RADIUS, thickness=WALL), friction=0.4, softness=np.log(10.0) / (1.4 * spacing))
    grains = mpm.make_scene(
        grid=Grid(shape=(nx, ny, nz), spacing=cell, origin=tuple(lower)),
        dt=dt,
        material=Material(
            density=100.0,
            elasticity=Hencky(youngs_modulus=4e3, poissons_ratio=0.3),
            plasticity=DruckerPrager(friction_angle=0.5, cohesion=0.0),
        ),
        particle_volume=spacing**3,
        colliders=(bowl,),
        walls=box_walls(ROOM[0][1], (ROOM[0][0], ROOM[0][2]), (ROOM[1][0], ROOM[1][2])),
        max_active_nodes=max_active_nodes,
    )
    cloth = thin.isotropic_cloth(youngs_modulus=3e4, poissons_ratio=0.3, thickness=1e-3, density=2000.0, damping=3e-4)
    sheet = thin.make_scene(mesh=mesh, dt=dt, cloth=cloth.replace(bending=1e-4), held=held, drag=1.0)
    contact = ParticleContact(
        thickness=spacing,
        stiffness=stiffness,
        damping=1.2e-4 * stiffness,
        friction=0.4,
        friction_damping=1.2e-4 * stiffness,
        max_speed=2.2,
        every=5,
        pairs_per_particle=9,
    )
    return coupling.make_mixed_scene(particles=grains, thin=sheet, contact=contact, vertices=mesh.vertices)


def _pour_bag(
    steps: Substeps,
    *,
    cells: int,
    spacing: float,
    stiffness: float,
    max_active_nodes: int,
    top: float,
    cloud: PointCloud,
    max_steps: int,
) -> PourBag:
    mesh, held = bag(cells)
    return PourBag(
        scene=bag_of_grains(steps.dt, mesh, held, spacing, stiffness, max_active_nodes),
        rest_positions=np.concatenate([grains_in_bag(spacing, 0.9 * spacing, top), mesh.vertices]) + START,
        noise=reset_noise((-0.03, 0.0, -0.03), (0.03, 0.0, 0.03)),
        joint_start=(*START, WIDTH, 0.0),
        joint_lower=(-0.35, 0.36, -0.1, 0.6 * WIDTH, -0.3),
        joint_upper=(0.1, 0.5, 0.1, WIDTH, 2.4),
        joint_step=(0.02, 0.01, 0.01, 0.005, 0.1),
        rate=12.0,
        bowl=(0.0, RIM, 0.0),
        rim=RADIUS - 0.5 * WALL,
        scale=0.15,
        spilling=0.5,
        thickness=0.006,
        cloud=cloud,
        vertex_stride=2,
        num_substeps=steps.num,
        max_steps=max_steps,
    )


def paper(*, dt: float | None = None, num_substeps: int | None = None) -> PourBag:
    """A bag of 288 triangles and grains of 1 cm."""
    return _pour_bag(
        substeps(dt, num_substeps, Substeps(8e-4, 50)),
        cells=12,
        spacing=0.01,
        stiffness=51.0,
        max_active_nodes=8192,  # 3777 sufficed for the largest actions, which spill grains
        top=-0.02,
        cloud=PointCloud(num_points=214, stride=3),
        max_steps=60,
    )


def small(*, dt: float | None = None, num_substeps: int | None = None) -> PourBag:
    """A bag of 72 triangles and grains of 1.75 cm, for two cores."""
    return _pour_bag(
        substeps(dt, num_substeps, Substeps(1.6e-3, 25)),
        cells=6,
        spacing=0.0175,
        stiffness=88.0,
        max_active_nodes=2560,  # 1398 sufficed for the largest actions, which spill grains
        top=0.0,
        cloud=PointCloud(num_points=64, stride=2),
        max_steps=40,
    )
