"""Hopper: a one-legged robot hops along x."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.options import Substeps, number_option, substeps
from rewax.envs.kit.rigid_task import RigidPhysics, RigidTask, load_asset, uniform
from rewax.physics import rigid
from rewax.physics.numerics.checks import NOT_NEGATIVE
from rewax.physics.rigid import Penalty, RigidState
from rewax.types import Array, Key, Observation, PyTree, Vector


@struct.dataclass
class Hopper(RigidTask):
    """The task; ``rewax.make("Hopper", scale=...)`` builds it.

    Observation ``state``, 11 numbers: height, pitch and the angles of thigh, leg and foot, then the rates of x, height,
    pitch and the three joints. The joint torques are 200 N m times the action. Height is relative to that of the torso
    in the model, 1.25 m.

    Attributes:
      fallen_height: height below which the episode ends [m].
    """

    fallen_height: Vector

    camera_body = 1

    def start(self, key: Key) -> tuple[RigidState, PyTree]:
        position_key, velocity_key = jax.random.split(key)
        return rigid.initial_state(self.model, uniform(position_key, 6, 0.05), uniform(velocity_key, 6, 0.05)), None

    def observe(self, physics: RigidPhysics) -> Observation:
        return {"state": jnp.concatenate([physics.rigid.qpos[1:], physics.rigid.qvel])}

    def reward(self, physics: RigidPhysics) -> tuple[Array, dict[str, Array]]:
        """Forward velocity + tall + 1 - (pitch / 30 degrees)^2 - 0.1 |action|^2.

        Let e = clip(height + 0.3 m, -1 m, 0.3 m). tall is e if e >= 0, and -200 e^2 otherwise.
        """
        _, height, pitch = physics.rigid.qpos[:3]
        velocity = physics.rigid.qvel[0]
        above = jnp.clip(height + 0.3, -1.0, 0.3)
        tall = jnp.where(above < 0.0, -200.0 * above**2, above)
        upright = 1.0 - pitch**2 / (np.pi / 6) ** 2
        reward = velocity + tall + upright - 0.1 * jnp.sum(physics.action**2)
        return reward, {"velocity": velocity, "height": height, "pitch": pitch}

    def terminated(self, physics: RigidPhysics) -> Array:
        return physics.rigid.qpos[1] < self.fallen_height


def make_hopper(*, scale: str, onset: float = 0.01, dt: float | None = None, num_substeps: int | None = None) -> Hopper:
    """Factory for the registry.

    Args:
      scale: ``"paper"``: 16 substeps and 1000 steps of 1/60 s; ``"small"``: 300 steps.
      onset: depth of contact at which damping reaches its full strength [m]. Rewarped has 0, a jump that no
        derivative contains (``docs/rigid_tasks.md``).
      dt, num_substeps: see ``rewax.make``.
    """
    steps = substeps(dt, num_substeps, Substeps(1.0 / 960, 16))
    onset = number_option("onset", onset, NOT_NEGATIVE, remedy="give a depth in metres")
    penalty = Penalty(stiffness=2e4, damping=1e3, friction_damping=1e3, onset=onset)
    model = load_asset("hopper.xml", dt=steps.dt, penalty=penalty)
    max_steps = {"paper": 1000, "small": 300}[scale]
    return Hopper(model=model, num_substeps=steps.num, max_steps=max_steps, fallen_height=-0.45)
