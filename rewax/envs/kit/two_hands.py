"""Base of tasks in which two hands hold cloth at two corners, move it and let it go."""

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.soft_task import SoftPhysics
from rewax.envs.kit.thin_task import ThinTask
from rewax.physics.numerics import Pose
from rewax.physics.thin import Grasp, ThinMesh
from rewax.types import Array, Observation

HANDS = 2
STILL = HANDS
"""Body of colliders that stay where they are."""
GRIP = 3 * HANDS
"""Joint that closes both hands."""


@struct.dataclass
class TwoHands(ThinTask):
    """A task whose seven joints are the positions of two hands [m] and their grip, 0 for open to 1 for closed.

    An episode begins with closed hands at the two corners. Colliders of the body ``STILL`` stay at the origin.

    Attributes:
      corners: vertices that the hands hold (static).
    """

    corners: tuple[int, int] = struct.static_field()

    def poses(self, joint_q: Array) -> Pose:
        hands = joint_q[:, :GRIP].reshape(-1, HANDS, 3)
        position = jnp.concatenate([hands, jnp.zeros_like(hands[:, :1])], axis=1)
        return Pose(position, jnp.broadcast_to(jnp.eye(3, dtype=position.dtype), (*position.shape, 3)))

    def grips(self, joint_q: Array) -> Array:
        return jnp.repeat(joint_q[:, GRIP:], HANDS, axis=1)

    def first_joints(self, physics: SoftPhysics) -> Array:
        return jnp.concatenate([physics.soft.x[jnp.array(self.corners)].reshape(-1), self.joint_start[GRIP:]])

    def observe(self, physics: SoftPhysics) -> Observation:
        """The observed points, and the hands, their motion, the corners, mean position and velocity of the cloth."""
        x, v = physics.soft.x, physics.soft.v
        corners = x[jnp.array(self.corners)].reshape(-1)
        vector = jnp.concatenate([physics.joint_q, physics.joint_qd, corners, x.mean(0), 0.5 * v.mean(0)])
        return {"particle_q": self.observed(physics), "vector": vector}


def hands_at(mesh: ThinMesh, corners: tuple[int, int], *, radius: float, stiffness: float) -> tuple[Grasp, ...]:
    """Grasps of the vertices around two corners.

    Args:
      mesh: the cloth.
      corners: their vertices.
      radius: distance at rest up to which vertices are held [m].
      stiffness: force per displacement of each held vertex [N/m].
    """
    grasps = []
    for body, corner in enumerate(corners):
        away = np.linalg.norm(mesh.vertices - mesh.vertices[corner], axis=-1)
        held = tuple(int(k) for k in np.flatnonzero(away <= radius))
        grasps.append(Grasp(body=body, vertices=held, stiffness=stiffness, damping=1e-4 * stiffness))
    return tuple(grasps)


__all__ = ["GRIP", "HANDS", "STILL", "TwoHands", "hands_at"]
