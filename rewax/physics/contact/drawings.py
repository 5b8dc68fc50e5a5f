"""Colliders in pictures."""

from collections.abc import Sequence
from typing import Any

from rewax.physics.contact.colliders import Collider, shape_pose
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.shapes.primitives import Box, Capsule, Cylinder, Sphere


def drawings(colliders: Sequence[Collider], bodies: Pose) -> list[dict[str, Any]]:
    """Drawings of colliders; ``rewax.viz.shapes`` has a table of their keys.

    Args:
      colliders: spheres, capsules, cylinders and boxes; others are left out.
      bodies: poses of the bodies that carry them, shapes (num_bodies, 3), (num_bodies, 3, 3).
    """
    found = []
    for collider in colliders:
        pose, shape = shape_pose(collider, body_pose(bodies, collider.body)), collider.shape
        drawing: dict[str, Any] = {"center": pose.position}
        match shape:
            case Sphere():
                found.append({**drawing, "kind": "sphere", "radius": shape.radius})
            case Capsule() | Cylinder():
                kind = "capsule" if isinstance(shape, Capsule) else "cylinder"
                size = {"radius": shape.radius, "half_length": shape.half_length}
                found.append({**drawing, "kind": kind, **size, "direction": pose.rotation[:, 1]})
            case Box():
                found.append({**drawing, "kind": "box", "half_size": shape.half_size, "rotation": pose.rotation})
    return found
