"""CoverBox: two hands drape a cloth over a box and let it go."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.soft_task import SoftPhysics
from rewax.envs.kit.start_noise import reset_noise
from rewax.envs.kit.two_hands import RATE, STILL, TwoHands, cloth_in_hands
from rewax.physics import thin
from rewax.physics.contact import Collider
from rewax.physics.shapes import Box
from rewax.sensors.camera import Camera
from rewax.sensors.framing import overlooking
from rewax.types import Array, Scalar, Vector

EDGE = 0.5
"""Edge of the cloth [m]."""
HALF_SIZE = (0.1, 0.06, 0.1)
"""Half edges of the box, which stands on the ground in the middle [m]."""
START = (-0.32, 0.56)
"""x and y of the held edge at the beginning [m]."""
SPEED = 0.03
"""Largest motion of a hand's set point in a control step [m]."""
SUCCESS = 0.9
"""Share of the box that has to be covered."""


@struct.dataclass
class CoverBox(TwoHands):
    """The task; ``rewax.make("CoverBox", scale=...)`` builds it.

    The cloth hangs beside the box, held by two hands; ``TwoHands`` describes the joints.

    Attributes:
      spots: points on the top and the sides of the box [m], shape (num_spots, 3).
      near: distance from the nearest vertex below which a spot counts as covered [m].
      softness: distance beyond ``near`` at which half of the reward of a spot is left [m].
    """

    spots: Vector
    near: Scalar
    softness: Scalar

    def reward(self, physics: SoftPhysics) -> tuple[Array, dict[str, Array]]:
        """Mean over the spots of 1 / (1 + (max(d - near, 0) / softness)^2), d the distance to the nearest vertex."""
        square = jnp.sum((self.spots[:, None] - physics.soft.x) ** 2, axis=-1).min(axis=1)
        beyond = jnp.maximum(jnp.sqrt(square + 1e-8) - self.near, 0.0) / self.softness
        reward = jnp.mean(1.0 / (1.0 + beyond**2))
        covered = jnp.mean((beyond <= 0.0).astype(reward.dtype))
        return reward, {"covered": covered, "success": (covered > SUCCESS).astype(reward.dtype)}

    @property
    def camera(self) -> dict[str, Any]:
        return {"azimuth": 25.0, "elevation": 25.0}

    @property
    def default_camera(self) -> Camera:
        return overlooking((0.0, 0.25, 0.0), 1.0, up=self.up)


def spots_of_box(half_size: Any, spacing: float) -> np.ndarray:
    """Points on the top and the four sides of a box that stands on the ground, shape (num_spots, 3).

    They are the centers of cells whose edges are at most ``spacing`` [m].
    """
    hx, hy, hz = half_size

    def cells(half: float) -> np.ndarray:
        count = int(np.ceil(2.0 * half / spacing))
        return half * (2.0 * np.arange(count) + 1.0 - count) / count

    def face(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        first, second = np.meshgrid(a, b, indexing="ij")
        return first.reshape(-1), second.reshape(-1)

    x, z = face(cells(hx), cells(hz))
    faces = [np.stack([x, np.full_like(x, 2.0 * hy), z], axis=-1)]
    for sign in (-1.0, 1.0):
        y, z = face(hy + cells(hy), cells(hz))
        faces.append(np.stack([np.full_like(y, sign * hx), y, z], axis=-1))
        x, y = face(cells(hx), hy + cells(hy))
        faces.append(np.stack([x, y, np.full_like(x, sign * hz)], axis=-1))
    return np.concatenate(faces)


def _cover_box(steps: Substeps, *, cells: int, cloud: PointCloud, max_steps: int) -> CoverBox:
    mesh, spacing = thin.sheet(EDGE, EDGE, cells, cells), EDGE / cells
    corners = (0, cells)
    scene = cloth_in_hands(
        mesh,
        corners,
        dt=steps.dt,
        spacing=spacing,
        bending=3e-4,
        friction=0.5,
        radius=0.018,
        colliders=(
            Collider(shape=Box(half_size=HALF_SIZE), body=STILL, offset=(0.0, HALF_SIZE[1], 0.0), friction=0.4),
        ),
    )
    u, w = mesh.vertices[:, 0], mesh.vertices[:, 2] - 0.5 * EDGE
    hanging = np.stack([np.full_like(u, START[0]), START[1] - u, w], axis=-1)
    reach = 0.45
    return CoverBox(
        scene=scene,
        rest_positions=hanging,
        corners=corners,
        noise=reset_noise((-0.03, 0.0, -0.05), (0.03, 0.0, 0.05)),
        joint_start=(*hanging[0], *hanging[cells], 1.0),
        joint_lower=(-reach, 0.15, -reach, -reach, 0.15, -reach, 0.0),
        joint_upper=(reach, 0.65, reach, reach, 0.65, reach, 1.0),
        joint_step=(*[SPEED] * 6, 0.25),
        rate=RATE,
        spots=spots_of_box(HALF_SIZE, 0.05),
        near=0.018 + 0.75 * spacing,
        softness=0.04,
        thickness=0.012,
        cloud=cloud,
        num_substeps=steps.num,
        max_steps=max_steps,
    )


def paper(*, dt: float | None = None, num_substeps: int | None = None) -> CoverBox:
    """A cloth of 2,048 triangles."""
    return _cover_box(
        substeps(dt, num_substeps, Substeps(2.5e-4, 100)),
        cells=32,
        cloud=PointCloud(num_points=250, stride=4),
        max_steps=120,
    )


def small(*, dt: float | None = None, num_substeps: int | None = None) -> CoverBox:
    """A cloth of 200 triangles, for two cores."""
    return _cover_box(
        substeps(dt, num_substeps, Substeps(1e-3, 25)),
        cells=10,
        cloud=PointCloud(num_points=61, stride=2),
        max_steps=60,
    )
