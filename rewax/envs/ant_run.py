"""AntRun: a four-legged ant runs as fast as it can (DiffRL's ant, as Rewarped simulates it), and DiffRL's own Ant.

The world's y axis points up; the ant runs along x. Scale ``paper`` has the reference's numbers; ``small`` has longer
substeps and shorter episodes.
"""

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.rigid_task import RigidPhysics, RigidTask, load_asset, random_turn, uniform, xyzw
from rewax.physics import rigid
from rewax.physics.rigid import RigidState
from rewax.physics.rigid_penalty import Penalty
from rewax.physics.rotations import quaternion_product, quaternion_to_matrix
from rewax.types import Array, Key, Observation, PyTree

_START_JOINTS = np.array([0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0])
_FORWARD, _UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
"""Axes of the torso, whose model is written z up."""


@struct.dataclass
class AntRun(RigidTask):
    """The environment; build it with ``rewax.make("AntRun", scale=...)``.

    Observation ``state``, 37 numbers: height (1), orientation x, y, z, w (4), velocity (3), angular velocity (3), joint
    angles (8), 0.1 joint rates (8), upright (1), heading (1), last action (8). An action times 200 N m, with its sign
    flipped as in the reference, is the torques of hip and ankle of each leg.

    Attributes:
      start_height: of the torso [m].
      fallen_height: below which the episode ends [m].
      target: where to run [m], shape (3,).
    """

    start_height: Array
    fallen_height: Array
    target: Array

    def start(self, key: Key) -> tuple[RigidState, PyTree]:
        keys = jax.random.split(key, 4)
        home = self.model.home
        place = jnp.zeros(3).at[1].set(self.start_height) + uniform(keys[0], 3, 0.1)
        turn = quaternion_product(home[3:7], random_turn(keys[1], np.pi / 24))
        joints = _START_JOINTS + uniform(keys[2], 8, 0.2)
        # Of velocities the model takes the angular one in the torso's frame; uniform noise has none to prefer.
        velocity = uniform(keys[3], self.model.num_dofs, 0.25)
        return rigid.initial_state(self.model, jnp.concatenate([place, turn, joints]), velocity), None

    def control(self, action: Array) -> Array:
        return -action

    def observe(self, physics: RigidPhysics) -> Observation:
        q, v = physics.rigid.qpos, physics.rigid.qvel
        rotation, upright, heading = self._posture(q)
        posture = [q[1:2], xyzw(q[3:7]), v[:3], rotation @ v[3:6]]
        joints = [q[7:], 0.1 * v[6:], upright[None], heading[None], physics.action]
        return {"state": jnp.concatenate([*posture, *joints])}

    def reward(self, physics: RigidPhysics) -> tuple[Array, dict[str, Array]]:
        """Forward velocity + 0.1 upright + heading + height above the fallen one."""
        q, v = physics.rigid.qpos, physics.rigid.qvel
        _, upright, heading = self._posture(q)
        reward = v[0] + 0.1 * upright + heading + q[1] - self.fallen_height
        return reward, {"velocity": v[0], "upright": upright, "heading": heading, "height": q[1]}

    def terminated(self, physics: RigidPhysics) -> Array:
        return physics.rigid.qpos[1] < self.fallen_height

    def _posture(self, q: Array) -> tuple[Array, Array, Array]:
        """Rotation of the torso, cosine between its up and the world's, and between its forward and the target."""
        rotation = quaternion_to_matrix(q[3:7])
        ahead = (self.target - q[:3]) * np.array([1.0, 0.0, 1.0])
        ahead = ahead / jnp.linalg.norm(ahead)
        return rotation, rotation[1] @ _UP, jnp.sum(rotation @ _FORWARD * ahead)


def _ant(penalty: Penalty, *, num_substeps: int, max_steps: int, armature: float) -> AntRun:
    model = load_asset("ant.xml", dt=1.0 / 60 / num_substeps, penalty=penalty)
    if armature:
        hinges = jnp.zeros(model.num_dofs).at[6:].set(armature)
        model = model.with_parameters(dof_armature=hinges)
    return AntRun(
        model=model,
        num_substeps=num_substeps,
        max_steps=max_steps,
        start_height=jnp.asarray(0.75),
        fallen_height=jnp.asarray(0.27),
        target=jnp.asarray([1e4, 0.0, 0.0]),
    )


def make_ant_run(*, scale: str, onset: float = 0.0) -> AntRun:
    """Factory for the registry.

    Args:
      scale: ``"paper"``: the reference's 16 substeps and 1000 steps; ``"small"``: 8 substeps, 300 steps.
      onset: depth over which the contacts' damping sets in [m]; the reference has 0.
    """
    # Stiffness and damping of the reference's contacts: means of the ant's and the ground's.
    penalty = Penalty(stiffness=52e3, damping=1e3, friction_damping=650.0, onset=onset)
    num_substeps, max_steps = {"paper": (16, 1000), "small": (8, 300)}[scale]
    return _ant(penalty, num_substeps=num_substeps, max_steps=max_steps, armature=0.0)


def make_ant(*, scale: str) -> AntRun:
    """Ant of the dflex suite: DiffRL's contacts and armature; otherwise as ``make_ant_run``."""
    penalty = Penalty(stiffness=4e4, damping=1e4, friction_damping=3e3)
    num_substeps, max_steps = {"paper": (16, 1000), "small": (16, 300)}[scale]
    ant = _ant(penalty, num_substeps=num_substeps, max_steps=max_steps, armature=0.05)
    friction = ant.model.parameters["pair_friction"].at[:, :2].set(0.75)
    return ant.replace(model=ant.model.with_parameters(pair_friction=friction))
