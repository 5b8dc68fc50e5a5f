"""FoldCloth: two hands fold a towel in half.

The towel lies on the ground, shifted and with wrinkles. The hands hold two of its corners.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.soft_body import Soft
from rewax.envs.kit.soft_task import SoftPhysics
from rewax.envs.kit.start_noise import reset_noise
from rewax.envs.kit.two_hands import RATE, TwoHands, cloth_in_hands
from rewax.physics import thin
from rewax.sensors.camera import Camera
from rewax.sensors.framing import overlooking
from rewax.types import Array, Key, PyTree, Scalar

EDGE = 0.4
"""Edge of the towel [m]."""
RADIUS = 0.005
"""Distance of vertices on the ground from the ground, and thickness of the towel in self-contact [m]."""
SPEED = 0.025
"""Largest motion of a hand's set point in a control step [m]."""
LANE = 0.06
"""Largest distance of a hand along z from its side of the towel [m]: hands cannot tear the corners apart."""
LOWEST = 0.04
"""Least height of the set points of hands [m]: corners that slide along the ground roll the towel in."""
SUCCESS = 0.04
"""Largest mean distance between vertices and their mirror images of a folded towel [m]."""
WAVES = 3
"""Wrinkles along each axis at most."""


@struct.dataclass
class FoldCloth(TwoHands):
    """The task; ``rewax.make("FoldCloth", scale=...)`` builds it; ``TwoHands`` describes the joints.

    Attributes:
      wrinkle: amplitude of the wrinkles at the beginning [m].
      flatness, spread: weights of the two penalties in the reward.
      cells: cells along an edge of the towel, an even number (static).
    """

    wrinkle: Scalar
    flatness: Scalar
    spread: Scalar
    cells: int = struct.static_field()
    noise_fields: ClassVar[tuple[str, ...]] = ("noise", "wrinkle")

    def start(self, positions: Array, key: Key) -> tuple[Soft, PyTree]:
        amplitude_key, phase_key = jax.random.split(key)
        u = 2.0 * jnp.pi * (self.rest_positions[:, jnp.array([0, 2])] / EDGE)
        count = jnp.arange(WAVES + 1.0)
        shape = (WAVES + 1, WAVES + 1)
        phase = 2.0 * jnp.pi * jax.random.uniform(phase_key, (2, *shape))
        waves = jnp.cos(u[:, 0, None, None] * count[:, None] + phase[0]) * jnp.cos(
            u[:, 1, None, None] * count + phase[1]
        )
        size = self.wrinkle * jax.random.uniform(amplitude_key, shape) / (WAVES + 1)
        height = jnp.sum(size * waves, axis=(1, 2))
        up = (height - height.min())[:, None] * jnp.array([0.0, 1.0, 0.0])
        return self.at_rest(positions + up), None

    def reward(self, physics: SoftPhysics) -> tuple[Array, dict[str, Array]]:
        """(D_0 - D) / D_0 - flatness h / edge - spread |1 - A|.

        D is the mean distance between the vertices of one half and their mirror images on the other, D_0 that of the
        flat towel. h is the mean height of all vertices above the ground. A is the area from above of the surface in
        the middle between both halves, over half of the towel's area.
        """
        n = self.cells + 1
        grid = physics.soft.x.reshape(n, n, 3)
        left, right = grid[: n // 2], grid[::-1][: n // 2]
        gap = jnp.sqrt(jnp.sum((left - right) ** 2, axis=-1) + 1e-6).mean()
        height = physics.soft.x[:, 1].mean() - RADIUS
        area = self._area(grid)
        flat = EDGE * (self.cells + 2) / (2 * self.cells)
        reward = 1.0 - gap / flat - self.flatness * height / EDGE - self.spread * jnp.abs(1.0 - area)
        success = (gap < SUCCESS) & (height < 0.5 * SUCCESS) & (area > 0.8)
        return reward, {"gap": gap, "height": height, "area": area, "success": success.astype(gap.dtype)}

    def _area(self, grid: Array) -> Array:
        """Area from above of the surface in the middle between both halves, over half of the towel's area [-]."""
        n = self.cells + 1
        half = 0.5 * (grid[: n // 2 + 1] + grid[::-1][: n // 2 + 1])
        a, b = half[1:, :-1] - half[:-1, 1:], half[1:, 1:] - half[:-1, :-1]  # diagonals of the cells
        cells = 0.5 * (a[..., 0] * b[..., 2] - a[..., 2] * b[..., 0])
        return jnp.sum(cells) / (0.5 * EDGE**2)

    @property
    def camera(self) -> dict[str, Any]:
        return {"azimuth": 20.0, "elevation": 35.0}

    @property
    def default_camera(self) -> Camera:
        return overlooking((0.0, 0.05, 0.0), 0.7, up=self.up)


def _fold_cloth(
    steps: Substeps, *, cells: int, cloud: PointCloud, max_steps: int, self_contact: thin.SelfContact | None = None
) -> FoldCloth:
    mesh, spacing = thin.sheet(EDGE, EDGE, cells, cells), EDGE / cells
    corners = (cells * (cells + 1), (cells + 1) ** 2 - 1)
    scene = cloth_in_hands(
        mesh,
        corners,
        dt=steps.dt,
        spacing=spacing,
        bending=1e-4,
        friction=0.8,
        radius=RADIUS,
        self_contact=self_contact,
    )
    lying, side = mesh.vertices + np.array([-0.5 * EDGE, RADIUS, -0.5 * EDGE]), 0.5 * EDGE
    return FoldCloth(
        scene=scene,
        rest_positions=lying,
        corners=corners,
        noise=reset_noise((-0.03, 0.0, -0.03), (0.03, 0.0, 0.03)),
        joint_start=(*lying[corners[0]], *lying[corners[1]], 1.0),
        joint_lower=(-0.35, LOWEST, -side - LANE, -0.35, LOWEST, side - LANE, 0.0),
        joint_upper=(0.35, 0.35, -side + LANE, 0.35, 0.35, side + LANE, 1.0),
        joint_step=(*[SPEED] * 6, 0.25),
        rate=RATE,
        wrinkle=0.02,
        flatness=0.3,
        spread=0.5,
        cells=cells,
        thickness=0.006,
        cloud=cloud,
        num_substeps=steps.num,
        max_steps=max_steps,
    )


def _layers(spacing: float, max_speed: float) -> thin.SelfContact:
    """Contact of the towel's layers."""
    mass = 0.4 * spacing**2
    return thin.SelfContact(
        thickness=RADIUS,
        stiffness=8e4 * mass,
        damping=5.0 * mass,
        friction=0.5,
        friction_damping=50.0 * mass,
        max_speed=max_speed,
    )


def paper(*, dt: float | None = None, num_substeps: int | None = None) -> FoldCloth:
    """A towel of 1,152 triangles."""
    return _fold_cloth(
        substeps(dt, num_substeps, Substeps(2e-4, 200)),
        cells=24,
        cloud=PointCloud(num_points=209, stride=3),
        max_steps=120,
        self_contact=_layers(EDGE / 24, 0.7),
    )


def small(*, dt: float | None = None, num_substeps: int | None = None) -> FoldCloth:
    """A towel of 128 triangles, for two cores."""
    return _fold_cloth(
        substeps(dt, num_substeps, Substeps(1e-3, 40)), cells=8, cloud=PointCloud(num_points=81), max_steps=50
    )
