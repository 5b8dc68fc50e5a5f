"""Colliders in pictures."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from rewax.physics.contact.colliders import Collider, shape_pose
from rewax.physics.numerics.pose import Pose, body_pose


def drawings(colliders: Sequence[Collider], bodies: Pose) -> list[dict[str, Any]]:
    """Drawings of colliders; ``rewax.viz.shapes`` has a table of their keys.

    Args:
      colliders: of any shape, each drawn as its method ``draw`` says. Planes are left out; so are sampled distances,
        height fields and shapes that do not write ``draw`` where their numbers are traced, and where scikit-image,
        which makes triangles of distances, is missing.
      bodies: poses of the bodies that carry them, shapes (num_bodies, 3), (num_bodies, 3, 3).
    """
    found = []
    for collider in colliders:
        pose = shape_pose(collider, body_pose(bodies, collider.body))
        found += [_placed(drawing, pose) for drawing in collider.shape.draw()]
    return found


def _placed(drawing: dict[str, Any], pose: Pose) -> dict[str, Any]:
    """A drawing in the shape's frame, in the world."""
    turned = {
        key: jnp.matmul(pose.rotation, jnp.asarray(drawing[key], pose.rotation.dtype), precision="highest")
        for key in ("center", "direction", "rotation")
        if key in drawing
    }
    return {**drawing, **turned, "center": pose.position + turned.get("center", 0.0)}


__all__ = ["drawings"]
