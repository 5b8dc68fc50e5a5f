"""SteerFloat: a paddle steers a soft float across a basin of water onto a mark.

Not a task of the reference: two materials, water and an elastic solid, move each other. A paddle that does not touch
the float still moves it through the water, so the gradient says from the first step on where to stir. The paddle cannot
pull: a float that drifts beyond the mark has to be met from the other side.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.appearance import MARKER
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.soft_parts import box_walls, lattice_box, turn_about_y, water
from rewax.envs.kit.soft_task import Soft, SoftPhysics, SoftTask
from rewax.physics import mpm
from rewax.physics.contact import Collider
from rewax.physics.mpm import Grid, Material, NeoHookean, WallKind
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Box
from rewax.types import Array, Key, Observation, PyTree, Scalar, Vector

BASIN = ((0.05, 0.45), (0.075, 0.3), (0.05, 0.35))
"""Where its sides, floor and open top are, along x, y and z [m]."""
DEPTH = 0.075
"""Of the water [m]."""
FLOAT_SIZE = (0.075, 0.05, 0.075)
"""Edges of the float [m]."""
FLOAT_START = (0.2, 0.15, 0.2)
"""Its middle before the noise of a reset [m]."""
PADDLE = (0.025, 0.06, 0.05)
"""Half the paddle's edges [m]: two cells of the coarse grid thick, or water would pass through."""


@struct.dataclass
class SteerFloat(SoftTask):
    """The environment; build it with ``rewax.make("SteerFloat", scale=...)``.

    The joints are the paddle's place along x and z [m] and its turn about y [rad]. The first particles are the
    float's. The task keeps the mark's x and z [m], shape (2,).

    Attributes:
      mark_lower, mark_upper: range of the mark, from the float's first place along x and z [m], shape (2,).
      unit: distance from the mark at which nothing is earned [m].
      float_count: particles of the float (static).
    """

    mark_lower: Vector
    mark_upper: Vector
    unit: Scalar
    float_count: int = struct.static_field()

    def start(self, positions: Array, key: Key) -> tuple[Soft, PyTree]:
        shift = jax.random.uniform(key, (2,), minval=self.mark_lower, maxval=self.mark_upper)
        return self.at_rest(positions), jnp.asarray(FLOAT_START)[jnp.array([0, 2])] + shift

    def poses(self, joint_q: Array) -> Pose:
        x, z, turn = joint_q[:, 0], joint_q[:, 1], joint_q[:, 2]
        height = jnp.full_like(x, BASIN[1][0] + PADDLE[1])
        position = jnp.stack([x, height, z], axis=-1)
        return Pose(position[:, None], turn_about_y(turn)[:, None])

    def observe(self, physics: SoftPhysics) -> Observation:
        x, v = (a[: self.float_count].mean(0) for a in (physics.soft.x, physics.soft.v))
        around = physics.joint_q[:2] - x[jnp.array([0, 2])]
        ahead = physics.task - x[jnp.array([0, 2])]
        vector = jnp.concatenate([x, v, around, physics.joint_q, physics.joint_qd, ahead])
        return {"particle_q": self.observed(physics) - x, "vector": vector}

    def reward(self, physics: SoftPhysics) -> tuple[Array, dict[str, Array]]:
        """1 - (d / unit)^2, d the distance of the float's middle from the mark along x and z [m]."""
        middle = physics.soft.x[: self.float_count].mean(0)
        square = jnp.sum((middle[jnp.array([0, 2])] - physics.task) ** 2)
        distance = jnp.sqrt(jax.lax.stop_gradient(square))
        success = (distance < 0.02).astype(square.dtype)
        return 1.0 - square / self.unit**2, {"distance": distance, "success": success}

    def render_shapes(self, physics: SoftPhysics) -> list[dict[str, Any]]:
        center = jnp.array([physics.task[0], BASIN[1][0] + DEPTH, physics.task[1]])
        return [
            *super().render_shapes(physics),
            {"kind": "sphere", "center": center, "radius": 0.015, "color": MARKER},
        ]

    @property
    def camera(self) -> dict[str, Any]:
        return {"azimuth": 15.0, "elevation": 38.0}


def _steer_float(*, spacing: float, counts: tuple[int, int, int], per_edge: float, dt: float, **changes) -> SteerFloat:
    """Water of ``counts`` particles in a lattice, and a float with ``per_edge`` metres between particles."""
    (left, right), (floor, _), (back, front) = BASIN
    size = (right - left, DEPTH, front - back)
    start = ((left + right) / 2, floor - spacing / 2 + DEPTH / 2, (back + front) / 2)
    pool = np.asarray(lattice_box(start, size, counts))
    float_counts = tuple(round(edge / per_edge) for edge in FLOAT_SIZE)
    solid = np.asarray(lattice_box(FLOAT_START, FLOAT_SIZE, float_counts))
    margin = 0.5 * size[0] / counts[0]  # particles stand for cells of the lattice, which reach half a cell further
    half, paddle = 0.5 * np.asarray(FLOAT_SIZE) + margin, np.asarray(PADDLE) + margin
    joint_start = (0.1, 0.2, 0.0)
    paddle_at = np.array([joint_start[0], floor + PADDLE[1], joint_start[1]])
    free = (np.abs(pool - FLOAT_START) > half).any(1) & (np.abs(pool - paddle_at) > paddle).any(1)
    pool = pool[free]
    volumes = [
        np.full(len(solid), np.prod(FLOAT_SIZE) / len(solid)),
        np.full(len(pool), np.prod(size) / np.prod(counts)),
    ]
    width, height, depth = (round(edge / spacing) + 1 for edge in (0.5, BASIN[1][1], 0.4))
    scene = mpm.make_scene(
        grid=Grid(shape=(width, height, depth), spacing=spacing),
        dt=dt,
        material=(
            Material(
                density=400.0,
                elasticity=NeoHookean(youngs_modulus=5e3, poissons_ratio=0.3),
            ),
            water(2.5e4),
        ),
        particle_counts=(len(solid), len(pool)),
        particle_volume=np.concatenate(volumes),  # pyright: ignore[reportArgumentType]
        gravity=(0.0, -9.81, 0.0),
        colliders=(
            Collider(
                shape=Box(half_size=PADDLE),
                friction=0.2,
                softness=7.5 / spacing,
            ),
        ),
        walls=box_walls(floor, (left, back), (right, front), floor_kind=WallKind.SEPARATING),
        **changes.pop("scene"),
    )
    return SteerFloat(
        scene=scene,
        float_count=len(solid),
        rest_positions=np.concatenate([solid, pool]),
        joint_start=joint_start,
        joint_lower=(left + 0.03, back + 0.05, -np.pi),
        joint_upper=(right - 0.03, front - 0.05, np.pi),
        mark_lower=(0.06, -0.05),
        mark_upper=(0.14, 0.05),
        unit=0.1,
        **changes,
    )


def paper() -> SteerFloat:
    """For an accelerator: cells of 1.25 cm, some 15,000 particles, six seconds."""
    return _steer_float(
        spacing=0.0125,
        counts=(48, 9, 36),
        per_edge=0.0083,
        dt=1e-3,
        scene={"max_active_nodes": 20480},
        joint_step=(0.01, 0.01, 0.1),
        cloud=PointCloud(num_points=250, stride=64),
        num_substeps=20,
        list_every=5,
        max_steps=300,
    )


def small() -> SteerFloat:
    """For two cores: cells of 2.5 cm, some 1200 particles, 1.2 s."""
    return _steer_float(
        spacing=0.025,
        counts=(20, 4, 15),
        per_edge=0.0125,
        dt=2e-3,
        scene={"max_active_nodes": 3328},
        joint_step=(0.01, 0.01, 0.1),
        cloud=PointCloud(num_points=64, stride=20),
        num_substeps=10,
        list_every=5,
        max_steps=60,
    )
