"""Articulated rigid bodies from MJCF models."""

from rewax.physics.rigid.contact_pair import ContactPair, Geom
from rewax.physics.rigid.geom_colliders import colliders, poses
from rewax.physics.rigid.model import PARAMETERS, RigidModel, RigidState, check_shape, load
from rewax.physics.rigid.queries import (
    body_name,
    body_poses,
    body_velocities,
    centers_of_mass,
    contact_distances,
    geom_poses,
    shapes,
    touching_bodies,
)
from rewax.physics.rigid.spring_contacts import Penalty
from rewax.physics.rigid.stale_mass import step_with_stale_mass
from rewax.physics.rigid.stepping import check_status, initial_state, step
from rewax.physics.rigid.touch import step_with_touch

__all__ = [
    "PARAMETERS", "ContactPair", "Geom", "Penalty", "RigidModel", "RigidState", "body_name", "body_poses",
    "body_velocities", "centers_of_mass", "check_shape", "check_status", "colliders", "contact_distances",
    "geom_poses", "initial_state", "load", "poses", "shapes", "step", "step_with_stale_mass", "step_with_touch",
    "touching_bodies",
]  # fmt: skip
