"""Cloth and ropes: shells of constant-strain triangles that bend at hinges, and polylines with stretch and bending."""

from rewax.physics.numerics.pose import static_poses
from rewax.physics.thin.grasps import Grasp, Hold
from rewax.physics.thin.implicit import Implicit
from rewax.physics.thin.invariants import (
    angular_momentum,
    elastic_energy,
    gravitational_energy,
    kinetic_energy,
    momentum,
)
from rewax.physics.thin.materials import BendingLaw, Cloth, MembraneLaw, Rope, isotropic_cloth
from rewax.physics.thin.pair_law import SelfContact
from rewax.physics.thin.rest import RestShape, rest_shape, vertex_mass
from rewax.physics.thin.safe_speed import largest_safe_speed
from rewax.physics.thin.scene import ThinScene, ThinState, initial_state, make_scene, no_creases
from rewax.physics.thin.stable_dt import largest_stable_dt
from rewax.physics.thin.stepping import (
    contact_force,
    internal_force,
    open_grasps,
    self_contact_force,
    step,
)
from rewax.physics.thin.thin_status import check_status
from rewax.physics.thin.thinmesh import ThinMesh, check_thinmesh, rope, sheet

__all__ = [
    "BendingLaw", "Cloth", "Grasp", "Hold", "Implicit", "MembraneLaw", "RestShape", "Rope", "SelfContact",
    "ThinMesh", "ThinScene", "ThinState", "angular_momentum", "check_status", "check_thinmesh", "contact_force",
    "elastic_energy", "gravitational_energy", "initial_state", "internal_force", "isotropic_cloth",
    "kinetic_energy", "largest_safe_speed", "largest_stable_dt", "make_scene", "momentum", "no_creases",
    "open_grasps", "rest_shape", "rope", "self_contact_force", "sheet", "static_poses", "step", "vertex_mass",
]  # fmt: skip
