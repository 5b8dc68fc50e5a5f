"""AntRun: a four-legged ant runs as fast as it can (DiffRL's ant, as Rewarped simulates it).

Ant is AntRun with DiffRL's contacts and armature. Scale ``paper`` has the numbers of Rewarped. Scale ``small`` has
shorter episodes and, in AntRun, longer substeps.
"""

import jax.numpy as jnp

from rewax import struct
from rewax.envs.kit.options import Substeps, flag_option, number_option, substeps
from rewax.envs.kit.rigid_task import RigidPhysics, load_asset
from rewax.envs.kit.runner import Runner
from rewax.physics import rigid
from rewax.physics.numerics.checks import NOT_NEGATIVE
from rewax.physics.rigid import Penalty
from rewax.types import Array

_START_JOINTS = (0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0)
_FIRST_LINK = 2
"""Index of the first link. Body 0 is the world, body 1 the torso; each hinge has one link."""


@struct.dataclass
class AntRun(Runner):
    """The task; ``rewax.make("AntRun", scale=...)`` builds it.

    Observation ``state``, 37 numbers, see ``Runner``. The torques of hip and ankle of each leg are -200 N m times the
    action.

    Attributes:
      stale_mass_matrix: compute the mass matrix once per control step, as Rewarped does (static).
    """

    stale_mass_matrix: bool = struct.static_field(default=False)

    def advance(self, physics: RigidPhysics, action: Array) -> tuple[RigidPhysics, Array]:
        if not self.stale_mass_matrix:
            return super().advance(physics, action)
        if self.touch is not None:
            raise ValueError("stale_mass_matrix is True, and its steps feel no contacts: give False, or no Touch")
        torques = self.control(action)
        bodies = rigid.step_with_stale_mass(self.model, physics.rigid, torques, num_substeps=self.num_substeps)
        return physics.replace(rigid=bodies, action=action), rigid.check_status(bodies, self.model)

    def reward(self, physics: RigidPhysics) -> tuple[Array, dict[str, Array]]:
        """Forward velocity + 0.1 upright + heading + height - fallen_height."""
        height, velocity = physics.rigid.qpos[1], physics.rigid.qvel[0]
        _, upright, heading = self.posture(physics)
        reward = velocity + 0.1 * upright + heading + height - self.fallen_height
        return reward, {"velocity": velocity, "upright": upright, "heading": heading, "height": height}


def _ant(asset: str, penalty: Penalty, steps: Substeps, *, max_steps: int) -> AntRun:
    return AntRun(
        model=load_asset(asset, dt=steps.dt, penalty=penalty),
        num_substeps=steps.num,
        max_steps=max_steps,
        start_height=0.75,
        start_joints=_START_JOINTS,
        fallen_height=0.27,
        target=[1e4, 0.0, 0.0],
    )


def make_ant_run(
    *,
    scale: str,
    onset: float = 0.0,
    stale_mass_matrix: bool = False,
    dt: float | None = None,
    num_substeps: int | None = None,
) -> AntRun:
    """Factory for the registry.

    Args:
      scale: ``"paper"``: Rewarped's 16 substeps and 1000 steps; ``"small"``: 8 substeps, 300 steps.
      onset: depth of contact at which damping reaches its full strength [m]; Rewarped has 0.
      stale_mass_matrix: compute the mass matrix at the first substep of a control step only, as Rewarped does.
        Torques without a cause then turn an ant that runs (``rigid.step_with_stale_mass``).
      dt, num_substeps: see ``rewax.make``.
    """
    onset = number_option("onset", onset, NOT_NEGATIVE, remedy="give a depth in metres")
    stale_mass_matrix = flag_option("stale_mass_matrix", stale_mass_matrix)
    # `among` is the ant's own law. The law with the ground has the means of the ant's and the ground's numbers.
    among = Penalty(stiffness=4e3, damping=1e3, friction_damping=300.0, onset=onset)
    penalty = Penalty(stiffness=52e3, damping=1e3, friction_damping=650.0, onset=onset, among=among, at_surfaces=True)
    own, max_steps = {"paper": (16, 1000), "small": (8, 300)}[scale]
    steps = substeps(dt, num_substeps, Substeps(1.0 / 60 / own, own))
    ant = _ant("ant_run.xml", penalty, steps, max_steps=max_steps)
    # Rewarped's importer adds the armature of a hinge to all moments of inertia of its link, too.
    armature = ant.model.parameters["dof_armature"][6:, None]
    inertia = ant.model.parameters["body_inertia"].at[_FIRST_LINK:].add(armature)
    return ant.replace(model=ant.model.with_parameters(body_inertia=inertia), stale_mass_matrix=stale_mass_matrix)


def make_ant(*, scale: str, dt: float | None = None, num_substeps: int | None = None) -> AntRun:
    """Ant of the dflex suite: AntRun with DiffRL's contacts and armature.

    Damping is proportional to depth. With full damping at the surface, a damper of this strength reverses the velocity
    of a leg within a substep, and gradients of 32 steps reach 1e16.
    """
    penalty = Penalty(stiffness=4e4, depth_damping=1e4, friction_damping=3e3)
    max_steps = {"paper": 1000, "small": 300}[scale]
    ant = _ant("ant.xml", penalty, substeps(dt, num_substeps, Substeps(1.0 / 60 / 16, 16)), max_steps=max_steps)
    friction = ant.model.parameters["pair_friction"].at[:, :2].set(0.75)
    armature = jnp.zeros(ant.model.num_dofs).at[6:].set(0.05)
    return ant.replace(model=ant.model.with_parameters(pair_friction=friction, dof_armature=armature))
