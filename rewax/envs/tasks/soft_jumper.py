"""SoftJumper: a soft table on four legs learns to leap, by muscles in all its tetrahedra.

At scale ``paper`` this is the task of the SAPO paper (gradSim's walker as Rewarped simulates it). Scale ``small`` has
the same body, longer substeps and shorter episodes.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.soft_task import SoftPhysics, SoftTask
from rewax.envs.kit.start_noise import reset_noise
from rewax.physics import tets
from rewax.physics.contact import Ground, PenaltyContact
from rewax.physics.tets import TetScene
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
    """The environment; build it with ``rewax.make("SoftJumper", scale=...)``.

    An action is the activation of two tets each, 222 in all; positive contracts.

    Attributes:
      strength: activation of a tet for action 1 [-].
      effort: price of the sum of squares of the actions.
      start_height: mean height of the vertices at rest [m].
      observation_scale: of positions and velocities.
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
        """v_x + 3 (y - y0) - 0.001 sum(a^2), of the mean of all vertices [m, m/s]; y0 is its height at rest."""
        speed, height = physics.soft.v[:, 0].mean(), physics.soft.x[:, 1].mean()
        effort = self.effort * jnp.sum(physics.action**2)
        reward = REFERENCE["forward"] * speed + REFERENCE["upward"] * (height - self.start_height) - effort
        return reward, {"speed": speed, "height": height, "effort": effort}


def _soft_jumper(*, dt: float, friction_damping: float = REFERENCE["friction_damping"], **changes: Any) -> SoftJumper:
    r, mesh = REFERENCE, tets.soft_jumper_table()
    scene = tets.make_scene(
        mesh=mesh,
        density=r["density"],
        mu=r["mu"],
        lam=r["lam"],
        damping=r["damping"],
        dt=dt,
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
        "num_substeps": r["num_substeps"],
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
        **options,
    )


def paper(*, dt: float = REFERENCE["dt"]) -> SoftJumper:
    """The reference's constants."""
    return _soft_jumper(dt=dt)


def small(*, dt: float = 1.0 / 60.0 / 16.0) -> SoftJumper:
    """The same task for minutes on two cores; ``docs/soft_tasks.md`` gives the reason for each difference."""
    return _soft_jumper(
        dt=dt,
        friction_damping=2.0,  # the reference's stops the lightest vertices more than twice over in a substep this long
        num_substeps=16,
        max_steps=90,
        noise=reset_noise((-0.8, 0.0, -0.8), (0.8, 0.1, 0.8), 0.02),
    )
