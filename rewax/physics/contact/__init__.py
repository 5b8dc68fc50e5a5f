"""Contact of moving shapes with grid nodes (velocity conditions) and with vertices (penalty forces)."""

from rewax.physics.contact.collider_drawings import drawings
from rewax.physics.contact.colliders import (
    Collider,
    Overlap,
    apply_collider,
    apply_colliders,
    check_bodies,
    place,
    shape_pose,
    with_softness,
)
from rewax.physics.contact.motion import Placed
from rewax.physics.contact.patches import WALLS, Patches, Wrench
from rewax.physics.contact.penalty import Ground, PenaltyContact, collider_force, ground_force, penalty_force

__all__ = [
    "WALLS", "Collider", "Ground", "Overlap", "Patches", "PenaltyContact", "Placed", "Wrench", "apply_collider",
    "apply_colliders", "check_bodies", "collider_force", "drawings", "ground_force", "penalty_force", "place",
    "shape_pose", "with_softness",
]  # fmt: skip
