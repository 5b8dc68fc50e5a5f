"""SoftJumper: a soft table on four legs learns to leap with muscles in all its tetrahedra.

Scale ``paper`` is the task of the SAPO paper (gradSim's walker as Rewarped simulates it). Scale ``small`` has the same
body, longer substeps and shorter episodes.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.soft_task import SoftPhysics, SoftTask
from rewax.envs.kit.start_noise import reset_noise
from rewax.physics import tets
from rewax.physics.contact import Ground, PenaltyContact
from rewax.physics.tets import TetScene
from rewax.sensors.camera import Camera
from rewax.sensors.framing import overlooking
from rewax.types import Array, Observation, Scalar

REFERENCE = {
    "dt": 1.0 / 60.0 / 80.0,
    "num_substeps": 80,
    "max_steps": 300,
    "gravity": -9.81,
    "density": 1.0,
    "mu": 1000.0,
    "lam": 1000.0,
    "damping": 1.0,
    "radius": 0.05,
    "contact_stiffness": 2e3,
    "contact_damping": 0.1,
    "friction_damping": 10.0,
    "friction": 0.7,
    "height": 0.2,
    "strength": 0.3,
    "observation_scale": 0.1,
    "forward": 1.0,
    "upward": 3.0,
    "effort": 0.001,
    "shift_lower": (-0.8, 0.0, -0.8),
    "shift_upper": (0.8, 0.4, 0.8),
    "stretch": 0.1,
    "num_observed": 204,
}
"""Xing, Luk and Oh 2025 and Rewarped; lengths in m, times in s, moduli in Pa."""


@struct.dataclass
class SoftJumper(SoftTask):
    """The task; ``rewax.make("SoftJumper", scale=...)`` builds it.

    Each of the 222 components of an action activates two tets; a positive one contracts them.

    Attributes:
      strength: activation of a tet for action 1 [-].
      effort: weight of the squared norm of the action in the reward.
      start_height: mean height of the vertices at rest [m].
      observation_scale: factor of observed positions and velocities (static).
    """

    strength: Scalar
    effort: Scalar
    start_height: Scalar
    observation_scale: float = struct.static_field(default=REFERENCE["observation_scale"])

    @property
    def num_actions(self) -> int:
        return -(-len(self.scene.tets) // 2)  # pyright: ignore[reportAttributeAccessIssue]

    def actuated(self, action: Array) -> TetScene:
        each = np.arange(len(self.scene.tets)) // 2  # pyright: ignore[reportAttributeAccessIssue]
        return self.scene.replace(activation=self.strength * action[each])  # pyright: ignore[reportReturnType]

    def points(self, physics: SoftPhysics) -> tuple[Array, Array]:
        return self.observation_scale * physics.soft.x, self.observation_scale * physics.soft.v

    def observe(self, physics: SoftPhysics) -> Observation:
        position, velocity = self.points(physics)
        return {
            "particle_q": self.cloud.pick(position),
            "com_q": position.mean(0),
            "com_qd": velocity.mean(0),
            "actions": physics.action,
        }

    def reward(self, physics: SoftPhysics) -> tuple[Array, dict[str, Array]]:
        """v_x + 3 (y - y0) - 0.001 |a|^2 [m, m/s]. v and y are means over the vertices, y0 is the height at rest."""
        speed, height = physics.soft.v[:, 0].mean(), physics.soft.x[:, 1].mean()
        effort = self.effort * jnp.sum(physics.action**2)
        reward = REFERENCE["forward"] * speed + REFERENCE["upward"] * (height - self.start_height) - effort
        return reward, {"speed": speed, "height": height, "effort": effort}

    @property
    def default_camera(self) -> Camera:
        return overlooking((0.5, 1.0, 0.15), 5.5, up=self.up)


def _soft_jumper(
    steps: Substeps, *, friction_damping: float = REFERENCE["friction_damping"], **changes: Any
) -> SoftJumper:
    r, mesh = REFERENCE, tets.soft_jumper_table()
    scene = tets.make_scene(
        mesh=mesh,
        density=r["density"],
        mu=r["mu"],
        lam=r["lam"],
        damping=r["damping"],
        dt=steps.dt,
        gravity=(0.0, r["gravity"], 0.0),
        contact=PenaltyContact(
            stiffness=r["contact_stiffness"],
            damping=r["contact_damping"],
            friction_damping=friction_damping,
            friction=r["friction"],
            radius=r["radius"],
        ),
        ground=Ground(normal=[0.0, 1.0, 0.0]),
    )
    rest = jnp.asarray(mesh.vertices + np.array([0.0, r["height"], 0.0]), jnp.result_type(float))
    options = {
        "max_steps": r["max_steps"],
        "noise": reset_noise(r["shift_lower"], r["shift_upper"], r["stretch"]),
        **changes,
    }
    return SoftJumper(
        scene=scene,
        rest_positions=rest,
        cloud=PointCloud(num_points=r["num_observed"]),
        strength=r["strength"],
        effort=r["effort"],
        start_height=rest[:, 1].mean(),
        num_substeps=steps.num,
        **options,
    )


def paper(*, dt: float | None = None, num_substeps: int | None = None) -> SoftJumper:
    """The constants of Rewarped."""
    return _soft_jumper(substeps(dt, num_substeps, Substeps(REFERENCE["dt"], REFERENCE["num_substeps"])))


def small(*, dt: float | None = None, num_substeps: int | None = None) -> SoftJumper:
    """A task that learns within minutes on two cores; ``docs/soft_tasks.md`` has the reason for each difference."""
    return _soft_jumper(
        substeps(dt, num_substeps, Substeps(1.0 / 60.0 / 16.0, 16)),
        friction_damping=2.0,  # with that of Rewarped, the lightest vertices are unstable: the substep is too long
        max_steps=90,
        noise=reset_noise((-0.8, 0.0, -0.8), (0.8, 0.1, 0.8), 0.02),
    )
