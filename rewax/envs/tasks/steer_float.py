"""SteerFloat: a paddle steers a soft float across a basin of water onto a mark.

Rewarped has no such task: two materials, water and an elastic solid, move each other. A paddle that does not
touch the float still moves it through the water, so the gradient is useful from the first step on. The paddle cannot
pull: it has to push a float that drifts beyond the mark from the other side.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.appearance import MARKER
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.soft_body import Soft
from rewax.envs.kit.soft_parts import box_walls, lattice_box, turn_about_y, water
from rewax.envs.kit.soft_task import SoftPhysics, SoftTask
from rewax.physics import mpm
from rewax.physics.contact import Collider
from rewax.physics.mpm import Grid, Material, NeoHookean, WallKind
from rewax.physics.numerics import Pose
from rewax.physics.shapes import Box
from rewax.sensors.camera import Camera
from rewax.sensors.framing import overlooking
from rewax.types import Array, Key, Observation, PyTree, Scalar, Vector

BASIN = ((0.05, 0.45), (0.075, 0.3), (0.05, 0.35))
"""Range of the basin along x, y and z [m]. It is open at the top."""
DEPTH = 0.075
"""Depth of the water [m]."""
FLOAT_SIZE = (0.075, 0.05, 0.075)
"""Edges of the float [m]."""
FLOAT_START = (0.2, 0.15, 0.2)
"""Center of the float at the beginning [m]."""
PADDLE = (0.0265, 0.0615, 0.0525)
"""Half edges of the paddle [m]. It is two cells of the coarse grid thick, so that no water passes through."""
PADDLE_START = (0.1035, 0.2)
"""x and z of the paddle at the beginning [m]. No node lies on its faces or has the same distance to two of them: there
its velocity would jump with the position of the paddle."""
_WITHOUT_WATER = (0.025, 0.06, 0.05)
"""Half edges of the box around the paddle that no water fills at the start [m]."""


@struct.dataclass
class SteerFloat(SoftTask):
    """The task; ``rewax.make("SteerFloat", scale=...)`` builds it.

    The joints are x and z of the paddle [m] and its rotation about y [rad]. The first particles are those of the float.
    ``physics.task`` is x and z of the mark [m], shape (2,).

    Attributes:
      mark_lower, mark_upper: range of the mark relative to the start of the float, along x and z [m], shape (2,).
      unit: distance between float and mark at which the reward is 0 [m].
      float_count: number of particles of the float (static).
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
        height = jnp.full_like(x, BASIN[1][0] + _WITHOUT_WATER[1])
        position = jnp.stack([x, height, z], axis=-1)
        return Pose(position[:, None], turn_about_y(turn)[:, None])

    def points(self, physics: SoftPhysics) -> tuple[Array, Array]:
        return physics.soft.x - physics.soft.x[: self.float_count].mean(0), physics.soft.v

    def observe(self, physics: SoftPhysics) -> Observation:
        x, v = (a[: self.float_count].mean(0) for a in (physics.soft.x, physics.soft.v))
        around = physics.joint_q[:2] - x[jnp.array([0, 2])]
        ahead = physics.task - x[jnp.array([0, 2])]
        vector = jnp.concatenate([x, v, around, physics.joint_q, physics.joint_qd, ahead])
        return {"particle_q": self.observed(physics), "vector": vector}

    def reward(self, physics: SoftPhysics) -> tuple[Array, dict[str, Array]]:
        """1 - (d / unit)^2, with d the horizontal distance between the center of the float and the mark [m]."""
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

    @property
    def default_camera(self) -> Camera:
        return overlooking((0.25538552, 0.105260946, 0.2), 0.53, up=self.up)


def _steer_float(
    steps: Substeps,
    *,
    spacing: float,
    counts: tuple[int, int, int],
    per_edge: float,
    max_active_nodes: int,
    cloud: PointCloud,
    max_steps: int,
) -> SteerFloat:
    """Water of ``counts`` particles in a lattice, and a float with ``per_edge`` [m] between its particles."""
    (left, right), (floor, _), (back, front) = BASIN
    size = (right - left, DEPTH, front - back)
    start = ((left + right) / 2, floor - spacing / 2 + DEPTH / 2, (back + front) / 2)
    pool = np.asarray(lattice_box(start, size, counts))
    float_counts = tuple(round(edge / per_edge) for edge in FLOAT_SIZE)
    solid = np.asarray(lattice_box(FLOAT_START, FLOAT_SIZE, float_counts))
    # A particle fills a cell of the lattice, which reaches half a cell further; those that touch are left out, whatever
    # rounding says.
    margin = 0.5 * size[0] / counts[0] + 1e-6
    half, paddle = 0.5 * np.asarray(FLOAT_SIZE) + margin, np.asarray(_WITHOUT_WATER) + margin
    joint_start = (*PADDLE_START, 0.0)
    paddle_at = np.array([joint_start[0], floor + _WITHOUT_WATER[1], joint_start[1]])
    free = (np.abs(pool - FLOAT_START) > half).any(1) & (np.abs(pool - paddle_at) > paddle).any(1)
    pool = pool[free]
    volumes = [
        np.full(len(solid), np.prod(FLOAT_SIZE) / len(solid)),
        np.full(len(pool), np.prod(size) / np.prod(counts)),
    ]
    width, height, depth = (round(edge / spacing) + 1 for edge in (0.5, BASIN[1][1], 0.4))
    scene = mpm.make_scene(
        grid=Grid(shape=(width, height, depth), spacing=spacing),
        dt=steps.dt,
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
        max_active_nodes=max_active_nodes,
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
        joint_step=(0.01, 0.01, 0.1),
        cloud=cloud,
        num_substeps=steps.num,
        list_every=steps.list_every,
        max_steps=max_steps,
    )


def paper(*, dt: float | None = None, num_substeps: int | None = None) -> SteerFloat:
    """For an accelerator: cells of 1.25 cm, some 15,000 particles, six seconds."""
    return _steer_float(
        substeps(dt, num_substeps, Substeps(1e-3, 20, list_every=5)),
        spacing=0.0125,
        counts=(48, 9, 36),
        per_edge=0.0083,
        max_active_nodes=20480,
        cloud=PointCloud(num_points=250, stride=64),
        max_steps=300,
    )


def small(*, dt: float | None = None, num_substeps: int | None = None) -> SteerFloat:
    """For two cores: cells of 2.5 cm, some 1200 particles, 1.2 s."""
    return _steer_float(
        substeps(dt, num_substeps, Substeps(2e-3, 10, list_every=5)),
        spacing=0.025,
        counts=(20, 4, 15),
        per_edge=0.0125,
        max_active_nodes=3328,
        cloud=PointCloud(num_points=64, stride=20),
        max_steps=60,
    )
