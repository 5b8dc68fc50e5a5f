"""What a moving shape does to whatever it touches."""

from rewax.physics.contact.colliders import (
    Collider,
    Overlap,
    apply_colliders,
    check_bodies,
    shape_pose,
    with_softness,
)
from rewax.physics.contact.drawings import drawings
from rewax.physics.contact.penalty import Ground, PenaltyContact, collider_force, ground_force, penalty_force

__all__ = [
    "Collider", "Ground", "Overlap", "PenaltyContact", "apply_colliders", "check_bodies", "collider_force",
    "drawings", "ground_force", "penalty_force", "shape_pose", "with_softness",
]  # fmt: skip
