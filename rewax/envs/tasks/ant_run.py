"""AntRun: a four-legged ant runs as fast as it can (DiffRL's ant, as Rewarped simulates it), and DiffRL's own Ant.

Scale ``paper`` has the reference's numbers; ``small`` has shorter episodes and, in AntRun, longer substeps.
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
"""Bodies are the world, the torso, then the eight links, one per hinge."""


@struct.dataclass
class AntRun(Runner):
    """The environment; build it with ``rewax.make("AntRun", scale=...)``.

    Observation ``state``, 37 numbers, see ``Runner``. An action times 200 N m, with its sign flipped, is the torques of
    hip and ankle of each leg.

    Attributes:
      stale_mass_matrix: compute the mass matrix once per control step, as the reference does (static).
    """

    stale_mass_matrix: bool = struct.static_field(default=False)

    def advance(self, physics: RigidPhysics, action: Array) -> tuple[RigidPhysics, Array]:
        if not self.stale_mass_matrix:
            return super().advance(physics, action)
        torques = self.control(action)
        bodies = rigid.step_with_stale_mass(self.model, physics.rigid, torques, num_substeps=self.num_substeps)
        return physics.replace(rigid=bodies, action=action), rigid.check_status(bodies, self.model)

    def reward(self, physics: RigidPhysics) -> tuple[Array, dict[str, Array]]:
        """Forward velocity + 0.1 upright + heading + height above the fallen one."""
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
      scale: ``"paper"``: the reference's 16 substeps and 1000 steps; ``"small"``: 8 substeps, 300 steps.
      onset: depth over which the contacts' damping sets in [m]; the reference has 0.
      stale_mass_matrix: compute the mass matrix at the first substep of a control step alone, as the reference does:
        an ant that runs is then turned by torques that no force makes (``rigid.step_with_stale_mass``).
    """
    onset = number_option("onset", onset, NOT_NEGATIVE, remedy="give a depth in metres")
    stale_mass_matrix = flag_option("stale_mass_matrix", stale_mass_matrix)
    # The ant's own law where its links touch each other; with the ground the means of the ant's and the ground's.
    among = Penalty(stiffness=4e3, damping=1e3, friction_damping=300.0, onset=onset)
    penalty = Penalty(stiffness=52e3, damping=1e3, friction_damping=650.0, onset=onset, among=among, at_surfaces=True)
    own, max_steps = {"paper": (16, 1000), "small": (8, 300)}[scale]
    steps = substeps(dt, num_substeps, Substeps(1.0 / 60 / own, own))
    ant = _ant("ant_run.xml", penalty, steps, max_steps=max_steps)
    # The reference's importer adds a hinge's armature to all moments of inertia of its link as well.
    armature = ant.model.parameters["dof_armature"][6:, None]
    inertia = ant.model.parameters["body_inertia"].at[_FIRST_LINK:].add(armature)
    return ant.replace(model=ant.model.with_parameters(body_inertia=inertia), stale_mass_matrix=stale_mass_matrix)


def make_ant(*, scale: str, dt: float | None = None, num_substeps: int | None = None) -> AntRun:
    """Ant of the dflex suite: DiffRL's contacts, damped in proportion to their depth, and armature; else as AntRun.

    Set in at once, a damper as strong reverses the velocity of a leg within a substep, and gradients of 32 steps reach
    1e16.
    """
    penalty = Penalty(stiffness=4e4, depth_damping=1e4, friction_damping=3e3)
    max_steps = {"paper": 1000, "small": 300}[scale]
    ant = _ant("ant.xml", penalty, substeps(dt, num_substeps, Substeps(1.0 / 60 / 16, 16)), max_steps=max_steps)
    friction = ant.model.parameters["pair_friction"].at[:, :2].set(0.75)
    armature = jnp.zeros(ant.model.num_dofs).at[6:].set(0.05)
    return ant.replace(model=ant.model.with_parameters(pair_friction=friction, dof_armature=armature))
