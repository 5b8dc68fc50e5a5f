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
    """The task; ``rewax.make("Humanoid", scale=...)`` builds it.

    Observation ``state``, 76 numbers, see ``Runner``. The joint torques are -35 to -210 N m times the action, in the
    order abdomen (z, y, x), right hip (x, z, y), knee and ankle (y, x), the same on the left, right shoulder (1, 2) and
    elbow, the same on the left.
    """

    def reward(self, physics: RigidPhysics) -> tuple[Array, dict[str, Array]]:
        """Forward velocity + 0.1 upright + heading + standing - 0.002 |action|^2.

        Let e = clip(height - fallen_height - 0.1 m, -1 m, 0.1 m). standing is 10 e if e >= 0, and -200 e^2 otherwise.
        """
        height, velocity = physics.rigid.qpos[1], physics.rigid.qvel[0]
        _, upright, heading = self.posture(physics)
        above = jnp.clip(height - self.fallen_height - 0.1, -1.0, 0.1)
        standing = jnp.where(above < 0.0, -200.0 * above**2, 10.0 * above)
        reward = velocity + 0.1 * upright + heading + standing - 0.002 * jnp.sum(physics.action**2)
        return reward, {"velocity": velocity, "upright": upright, "heading": heading, "height": height}


def make_humanoid(*, scale: str, dt: float | None = None, num_substeps: int | None = None) -> Humanoid:
    """Factory for the registry. A control step lasts 1/60 s.

    The damping of contacts is proportional to their depth, as in DiffRL. With full damping at the surface, a damper of
    this strength throws light hands and feet back, and a fallen body does not come to rest.

    Args:
      scale: ``"paper"``: 48 substeps, 1000 steps and a friction damping of 1000 N s/m; ``"small"``: 16 substeps, 300
        steps and 300 N s/m, which is stable with this substep: gradients of 32 random steps stay below 1e4, not 1e6.
      dt, num_substeps: see ``rewax.make``.
    """
    own, max_steps, friction_damping = {"paper": (48, 1000, 1e3), "small": (16, 300, 3e2)}[scale]
    steps = substeps(dt, num_substeps, Substeps(1.0 / 60 / own, own))
    penalty = Penalty(stiffness=2e4, depth_damping=5e3, friction_damping=friction_damping)
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
