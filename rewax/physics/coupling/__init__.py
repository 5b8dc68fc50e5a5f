"""Rigid bodies and particles that push each other."""

from rewax.physics.coupling import articulated, free_body
from rewax.physics.coupling.exchange import Wrench, no_wrench
from rewax.physics.coupling.free_body import FreeBodies, Inertia, bodies_at_rest, inertia_of, poses, solid
from rewax.physics.coupling.particles import step
from rewax.physics.numerics.pose import static_poses

__all__ = [
    "FreeBodies", "Inertia", "Wrench", "articulated", "bodies_at_rest", "free_body", "inertia_of", "no_wrench", "poses",
    "solid", "static_poses", "step",
]  # fmt: skip
