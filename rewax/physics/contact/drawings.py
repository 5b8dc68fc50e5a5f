"""Colliders in pictures."""

from collections.abc import Sequence
from typing import Any

from rewax.physics.contact.colliders import Collider, shape_pose
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.shapes.primitives import (
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    HeightField,
    SampledDistance,
    Sphere,
)
from rewax.physics.shapes.sampled_surface import height_surface, sampled_surface


def drawings(colliders: Sequence[Collider], bodies: Pose) -> list[dict[str, Any]]:
    """Drawings of colliders; ``rewax.viz.shapes`` has a table of their keys.

    Args:
      colliders: of any shape. Planes are left out; so are sampled distances and height fields whose numbers are
        traced, and any sampled distance without scikit-image, which makes its triangles.
      bodies: poses of the bodies that carry them, shapes (num_bodies, 3), (num_bodies, 3, 3).
    """
    found = []
    for collider in colliders:
        pose, shape = shape_pose(collider, body_pose(bodies, collider.body)), collider.shape
        drawing: dict[str, Any] = {"center": pose.position}
        match shape:
            case Sphere():
                found.append({**drawing, "kind": "sphere", "radius": shape.radius})
            case Capsule() | Cylinder() | Cone():
                size = {"radius": shape.radius, "half_length": shape.half_length}
                kind = type(shape).__name__.lower()
                found.append({**drawing, "kind": kind, **size, "direction": pose.rotation[:, 1]})
            case Box():
                found.append({**drawing, "kind": "box", "half_size": shape.half_size, "rotation": pose.rotation})
            case Ellipsoid():
                found.append({**drawing, "kind": "ellipsoid", "semi_axes": shape.semi_axes, "rotation": pose.rotation})
            case SampledDistance() | HeightField():
                surface = height_surface(shape) if isinstance(shape, HeightField) else sampled_surface(shape)
                if surface is not None:
                    mesh = {"kind": "mesh", "vertices": surface[0], "triangles": surface[1]}
                    found.append({**drawing, **mesh, "rotation": pose.rotation})
    return found
