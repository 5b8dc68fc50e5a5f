"""HalfCheetah: a two-legged animal runs along x in a plane."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.options import Substeps, number_option, substeps
from rewax.envs.kit.rigid_task import RigidPhysics, RigidTask, load_asset, uniform
from rewax.physics import rigid
from rewax.physics.numerics.checks import NOT_NEGATIVE
from rewax.physics.rigid import Penalty, RigidState
from rewax.types import Array, Key, Observation, PyTree

_START = np.array([0.0, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


@struct.dataclass
class HalfCheetah(RigidTask):
    """The task; ``rewax.make("HalfCheetah", scale=...)`` builds it.

    Observation ``state``, 17 numbers: height, pitch, the angles of thigh, shin and foot of the back leg, then of the
    front leg, then the velocity along x and the rates of all of these. The joint torques are 200 N m times the action.
    Height is relative to that of the torso in the model, 1 m. Episodes end at their time limit only.
    """

    camera_body = 1

    def start(self, key: Key) -> tuple[RigidState, PyTree]:
        position_key, velocity_key = jax.random.split(key)
        qpos = _START + uniform(position_key, 9, 0.1)
        return rigid.initial_state(self.model, qpos, uniform(velocity_key, 9, 0.25)), None

    def observe(self, physics: RigidPhysics) -> Observation:
        return {"state": jnp.concatenate([physics.rigid.qpos[1:], physics.rigid.qvel])}

    def reward(self, physics: RigidPhysics) -> tuple[Array, dict[str, Array]]:
        """Forward velocity - 0.1 |action|^2."""
        velocity = physics.rigid.qvel[0]
        metrics = {"velocity": velocity, "height": physics.rigid.qpos[1], "pitch": physics.rigid.qpos[2]}
        return velocity - 0.1 * jnp.sum(physics.action**2), metrics


def make_half_cheetah(
    *, scale: str, onset: float = 0.0, dt: float | None = None, num_substeps: int | None = None
) -> HalfCheetah:
    """Factory for the registry. A control step lasts 1/60 s.

    Args:
      scale: ``"paper"``: 16 substeps and 1000 steps; ``"small"``: 8 substeps and 300 steps.
      onset: depth of contact at which damping reaches its full strength [m]; Rewarped has 0.
      dt, num_substeps: see ``rewax.make``.
    """
    own, max_steps = {"paper": (16, 1000), "small": (8, 300)}[scale]
    steps = substeps(dt, num_substeps, Substeps(1.0 / 60 / own, own))
    onset = number_option("onset", onset, NOT_NEGATIVE, remedy="give a depth in metres")
    penalty = Penalty(stiffness=2e4, damping=1e3, friction_damping=1e3, onset=onset)
    model = load_asset("half_cheetah.xml", dt=steps.dt, penalty=penalty)
    return HalfCheetah(model=model, num_substeps=steps.num, max_steps=max_steps)
