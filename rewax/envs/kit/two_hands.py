"""Base of tasks in which two hands hold cloth at two corners, move it and let it go."""

import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.set_points import Steered
from rewax.envs.kit.soft_task import SoftPhysics
from rewax.physics import thin
from rewax.physics.contact import Collider, Ground, PenaltyContact
from rewax.physics.numerics import Pose
from rewax.physics.thin import Grasp, SelfContact, ThinMesh, ThinScene
from rewax.types import Array, Observation

HANDS = 2
STILL = HANDS
"""Body of colliders that stay where they are."""
GRIP = 3 * HANDS
"""Joint that closes both hands."""
RATE = 15.0
"""Angular frequency with which hands follow their set points [rad/s]."""


@struct.dataclass
class TwoHands(Steered):
    """A task whose seven joints are the positions of two hands [m] and their grip, 0 for open to 1 for closed.

    Actions move the set points of the joints (``Steered``). An episode begins with closed hands at the two corners.
    Colliders of the body ``STILL`` stay at the origin.

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
        """The observed points, and a vector of shape (33,).

        The vector holds the joints, their velocities, their set points relative to them, the corners, and the cloth's
        mean position and half of its mean velocity.
        """
        x, v = physics.soft.x, physics.soft.v
        corners = x[jnp.array(self.corners)].reshape(-1)
        hands = [physics.joint_q, physics.joint_qd, self.ahead(physics)]
        vector = jnp.concatenate([*hands, corners, x.mean(0), 0.5 * v.mean(0)])
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


def cloth_in_hands(
    mesh: ThinMesh,
    corners: tuple[int, int],
    *,
    dt: float,
    spacing: float,
    bending: float,
    friction: float,
    radius: float,
    colliders: tuple[Collider, ...] = (),
    self_contact: SelfContact | None = None,
) -> ThinScene:
    """The scene of a cloth of 0.4 kg/m^2 above the ground, with a hand at each corner.

    Args:
      mesh: the cloth, of square cells.
      corners: the vertices that the hands hold.
      dt: duration of a substep [s].
      spacing: edge of a cell [m]. Contact and grasps are stiffer for larger cells, as the mass of a vertex is.
      bending: flexural rigidity [N m].
      friction: Coulomb coefficient of the ground [-].
      radius: distance from vertices at which contact begins [m].
      colliders: what else the cloth touches.
      self_contact: contact of its layers; None: none.
    """
    mass = 0.4 * spacing**2
    cloth = thin.isotropic_cloth(youngs_modulus=3e4, poissons_ratio=0.3, thickness=2e-3, density=200.0, damping=3e-4)
    return thin.make_scene(
        mesh=mesh,
        dt=dt,
        cloth=cloth.replace(bending=bending),
        drag=1.0,
        contact=PenaltyContact(
            stiffness=2e4 * mass,
            damping=30.0 * mass,
            friction_damping=300.0 * mass,
            friction=friction,
            radius=radius,
        ),
        ground=Ground(normal=[0.0, 1.0, 0.0]),
        colliders=colliders,
        grasps=hands_at(mesh, corners, radius=1.1 * spacing, stiffness=3e4 * mass),
        self_contact=self_contact,
    )


__all__ = ["GRIP", "HANDS", "RATE", "STILL", "TwoHands", "cloth_in_hands", "hands_at"]
