"""Base of AntRun and Humanoid: a legged body with a free joint runs along x; y points up."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.rigid_task import RigidPhysics, RigidTask, random_turn, uniform, xyzw
from rewax.physics import rigid
from rewax.physics.numerics import quaternion_product, quaternion_to_matrix
from rewax.physics.rigid import RigidState
from rewax.types import Array, Key, Observation, PyTree, Vector

_FORWARD, _UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
"""Axes in the frame of the torso, in which z points up."""


@struct.dataclass
class Runner(RigidTask):
    """A task on a model with one free joint, then hinges with one actuator each.

    With n hinges, observation ``state`` is 13 + 3 n numbers: height (1), orientation x, y, z, w (4), velocity (3),
    angular velocity (3), joint angles (n), 0.1 joint rates (n), upright (1), heading (1), last action (n). Actions
    have the opposite sign of the joints' torques, as in Rewarped. The episode ends when the torso is too low.

    Attributes:
      start_height: height of the torso at the start [m].
      start_joints: joint angles at the start [rad], shape (n,).
      fallen_height: height of the torso below which the episode ends [m].
      target: position to run to [m], shape (3,).
    """

    start_height: Vector
    start_joints: Vector
    fallen_height: Vector
    target: Vector

    camera_body = 1

    def start(self, key: Key) -> tuple[RigidState, PyTree]:
        """The model's pose with uniform noise: position 0.1 m, rotation 7.5 degrees, joints 0.2 rad, velocity 0.25."""
        keys = jax.random.split(key, 4)
        position = jnp.zeros(3).at[1].set(self.start_height) + uniform(keys[0], 3, 0.1)
        rotation = quaternion_product(self.model.home[3:7], random_turn(keys[1], np.pi / 24))
        joints = self.start_joints + uniform(keys[2], self.model.num_actuators, 0.2)
        # The angular part of qvel is in the torso's frame. The noise has no direction, so it needs no rotation.
        velocity = uniform(keys[3], self.model.num_dofs, 0.25)
        return rigid.initial_state(self.model, jnp.concatenate([position, rotation, joints]), velocity), None

    def control(self, action: Array) -> Array:
        return -action

    def observe(self, physics: RigidPhysics) -> Observation:
        q, v = physics.rigid.qpos, physics.rigid.qvel
        rotation, upright, heading = self.posture(physics)
        torso = [q[1:2], xyzw(q[3:7]), v[:3], rotation @ v[3:6]]
        joints = [q[7:], 0.1 * v[6:], upright[None], heading[None], physics.action]
        return {"state": jnp.concatenate([*torso, *joints])}

    def terminated(self, physics: RigidPhysics) -> Array:
        return physics.rigid.qpos[1] < self.fallen_height

    def posture(self, physics: RigidPhysics) -> tuple[Array, Array, Array]:
        """Rotation of the torso, cosine of its up axis to the world's, and of its forward axis to the target."""
        q = physics.rigid.qpos
        rotation = quaternion_to_matrix(q[3:7])
        ahead = (self.target - q[:3]) * np.array([1.0, 0.0, 1.0])
        ahead = ahead / jnp.linalg.norm(ahead)
        return rotation, rotation[1] @ _UP, jnp.sum(rotation @ _FORWARD * ahead)
