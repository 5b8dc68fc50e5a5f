"""Humanoid: a body with 21 joints runs along x."""

import jax.numpy as jnp

from rewax import struct
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.rigid_task import RigidPhysics, load_asset
from rewax.envs.kit.runner import Runner
from rewax.physics.rigid import Penalty
from rewax.types import Array


@struct.dataclass
class Humanoid(Runner):
    """The environment; build it with ``rewax.make("Humanoid", scale=...)``.

    Observation ``state``, 76 numbers, see ``Runner``. An action times 35 to 210 N m, with its sign flipped, is the
    torques of abdomen (z, y, x), right hip (x, z, y), knee and ankle (y, x), the same on the left, right shoulder (1,
    2) and elbow, the same on the left.
    """

    def reward(self, physics: RigidPhysics) -> tuple[Array, dict[str, Array]]:
        """Forward velocity + 0.1 upright + heading + standing - 0.002 |action|^2.

        With e the height above the fallen one plus 0.1 m, at most 0.1 m, standing is 10 e, or -200 e^2 if e < 0.
        """
        height, velocity = physics.rigid.qpos[1], physics.rigid.qvel[0]
        _, upright, heading = self.posture(physics)
        above = jnp.clip(height - self.fallen_height - 0.1, -1.0, 0.1)
        standing = jnp.where(above < 0.0, -200.0 * above**2, 10.0 * above)
        reward = velocity + 0.1 * upright + heading + standing - 0.002 * jnp.sum(physics.action**2)
        return reward, {"velocity": velocity, "upright": upright, "heading": heading, "height": height}


def make_humanoid(*, scale: str, dt: float | None = None, num_substeps: int | None = None) -> Humanoid:
    """Factory for the registry: 48 substeps and 1000 steps of 1/60 s; ``small``: 16 substeps, 300 steps.

    Contacts are damped in proportion to their depth, as in DiffRL: set in at once, a damper as strong throws light
    hands and feet back, and falls do not come to rest. ``small`` rubs them with 300 N s/m instead of 1000, which its
    substep can follow: gradients of 32 random steps stay below 1e4 instead of 1e6.
    """
    own, max_steps, rubbing = {"paper": (48, 1000, 1e3), "small": (16, 300, 3e2)}[scale]
    steps = substeps(dt, num_substeps, Substeps(1.0 / 60 / own, own))
    penalty = Penalty(stiffness=2e4, depth_damping=5e3, friction_damping=rubbing)
    model = load_asset("humanoid.xml", dt=steps.dt, penalty=penalty)
    return Humanoid(
        model=model,
        num_substeps=steps.num,
        max_steps=max_steps,
        start_height=1.35,
        start_joints=jnp.zeros(model.num_actuators),
        fallen_height=0.74,
        target=[200.0, 0.0, 0.0],
    )
