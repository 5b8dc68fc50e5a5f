"""Quadruped: a robot of 30 kg walks at 1 m/s. It shows how your own robot becomes a task.

A task needs a model in MJCF (``assets/quadruped.xml``; ``rigid.load`` takes any path or text), a substep that its
contacts allow, and a subclass of ``RigidTask`` with the start of an episode, the observation and the reward.

The terms of the reward are common for such robots (Hwangbo et al. 2019, Learning agile and dynamic motor skills for
legged robots; Rudin et al. 2021, Learning to walk in minutes). The weights are chosen for this robot.
"""

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.rigid_task import RigidPhysics, RigidTask, load_asset, random_turn, uniform
from rewax.physics import rigid
from rewax.physics.numerics import quaternion_to_matrix
from rewax.physics.rigid import Penalty, RigidState
from rewax.types import Array, Key, Observation, PyTree, Vector

_WEIGHTS = {
    "velocity": 2.0,
    "yaw": 0.2,
    "vertical": -0.5,
    "rocking": -0.05,
    "tilt": -1.0,
    "torque": -2e-5,
    "change": -0.01,
}


@struct.dataclass
class Quadruped(RigidTask):
    """The task; ``rewax.make("Quadruped", scale=...)`` builds it.

    Observation ``state``, 45 numbers: in the trunk's frame velocity (3), angular velocity (3) and the direction of
    gravity (3); joint angles from the stance (12), 0.1 joint rates (12), last action (12). Per leg (left front, right
    front, left hind, right hind) the joints spread, swing and knee. The target angles of the joints' controllers are
    stance + reach * action. The controllers have 80 N m/rad and 3 N m s/rad, and exert at most 50 N m.

    Attributes:
      stance: target joint angles for action 0 [rad], shape (12,).
      reach: change of the target angles per unit of action [rad].
      command: desired velocity, forward and to the left in the frame of the trunk [m/s], shape (2,).
      fallen_height, fallen_upright: height of the trunk [m] and cosine of its tilt below which the episode ends.
    """

    stance: Vector
    reach: Vector
    command: Vector
    fallen_height: Vector
    fallen_upright: Vector

    camera_body = 1

    def start(self, key: Key) -> tuple[RigidState, PyTree]:
        turn_key, joint_key, velocity_key = jax.random.split(key, 3)
        position = self.model.home[:3] + np.array([0.0, 0.0, 0.01])
        joints = self.stance + uniform(joint_key, 12, 0.1)
        qpos = jnp.concatenate([position, random_turn(turn_key, np.pi / 36), joints])
        last_action = jnp.zeros(12)
        return rigid.initial_state(self.model, qpos, uniform(velocity_key, self.model.num_dofs, 0.1)), last_action

    def control(self, action: Array) -> Array:
        return self.stance + self.reach * action

    def observe(self, physics: RigidPhysics) -> Observation:
        q, v = physics.rigid.qpos, physics.rigid.qvel
        rotation = quaternion_to_matrix(q[3:7])
        trunk = [v[:3] @ rotation, v[3:6], -rotation[2]]
        return {"state": jnp.concatenate([*trunk, q[7:] - self.stance, 0.1 * v[6:], physics.action])}

    def reward(self, physics: RigidPhysics) -> tuple[Array, dict[str, Array]]:
        """Weighted sum of the terms in ``_WEIGHTS``.

        ``velocity`` (following the command) and ``yaw`` (not turning) are between 0 and 1. The other terms are squares
        of vertical velocity, roll and pitch rates, tilt, torques and the change of the action.
        """
        q, v = physics.rigid.qpos, physics.rigid.qvel
        rotation = quaternion_to_matrix(q[3:7])
        velocity = v[:3] @ rotation
        terms = {
            "velocity": jnp.exp(-2.0 * _square(velocity[:2] - self.command)),
            "yaw": jnp.exp(-4.0 * v[5] ** 2),
            "vertical": v[2] ** 2,
            "rocking": _square(v[3:5]),
            "tilt": _square(rotation[2, :2]),
            "torque": _square(self.torques(physics)),
            "change": _square(physics.action - physics.task),
        }
        reward = jnp.sum(jnp.stack([_WEIGHTS[name] * term for name, term in terms.items()]))
        return reward, {"forward": velocity[0], "height": q[2], **terms}

    def terminated(self, physics: RigidPhysics) -> Array:
        q = physics.rigid.qpos
        return (q[2] < self.fallen_height) | (quaternion_to_matrix(q[3:7])[2, 2] < self.fallen_upright)

    def next_task(self, physics: RigidPhysics, key: Key) -> PyTree:
        """The action of this step, with which the reward of the next step compares its own."""
        del key
        return physics.action

    def torques(self, physics: RigidPhysics) -> Array:
        """Torques of the joints' controllers in a state [N m], shape (12,)."""
        parameters = self.model.parameters
        stiffness, damping = parameters["actuator_gainprm"][:, 0], -parameters["actuator_biasprm"][:, 2]
        error = self.control(physics.action) - physics.rigid.qpos[7:]
        torque = stiffness * error - damping * physics.rigid.qvel[6:]
        return jnp.clip(torque, *parameters["actuator_forcerange"].T)


def _square(vector: Array) -> Array:
    return jnp.sum(vector**2)


def make_quadruped(*, scale: str, dt: float | None = None, num_substeps: int | None = None) -> Quadruped:
    """Factory for the registry.

    Args:
      scale: ``"paper"``: 20 substeps of 1 ms and 1000 steps; ``"small"``: 8 substeps of 2.5 ms and 300 steps.
      dt, num_substeps: see ``rewax.make``.
    """
    own, max_steps = {"paper": (20, 1000), "small": (8, 300)}[scale]
    steps = substeps(dt, num_substeps, Substeps(0.02 / own, own))
    penalty = Penalty(stiffness=1e4, damping=200.0, friction_damping=200.0, onset=0.01)
    model = load_asset("quadruped.xml", dt=steps.dt, penalty=penalty)
    return Quadruped(
        model=model,
        num_substeps=steps.num,
        max_steps=max_steps,
        stance=model.home[7:],
        reach=0.35,
        command=[1.0, 0.0],
        fallen_height=0.25,
        fallen_upright=0.5,
    )
