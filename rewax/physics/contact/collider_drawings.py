"""Colliders in pictures."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from rewax.physics.contact.colliders import COLLIDERS, Collider, check_bodies, shape_pose
from rewax.physics.numerics.fields import checked, poses
from rewax.physics.numerics.pose import Pose, body_pose


@checked(colliders=COLLIDERS, bodies=poses("num_bodies"))
def drawings(colliders: Sequence[Collider], bodies: Pose) -> list[dict[str, Any]]:
    """Drawings of colliders; ``rewax.viz.shapes`` has a table of their keys.

    Args:
      colliders: their shapes' method ``draw`` makes the drawings. Planes are left out. Sampled distances, height fields
        and shapes without a ``draw`` of their own are left out if their values are traced or scikit-image is missing,
        which computes triangles from distances.
      bodies: poses of the bodies that carry them, shapes (num_bodies, 3), (num_bodies, 3, 3).

    Raises:
      ValueError: a collider belongs to a body that has no pose.

    Gradient: exact with respect to poses and sizes; meshes are constants.
    """
    check_bodies(colliders, bodies.position.shape[0])
    found = []
    for collider in colliders:
        pose = shape_pose(collider, body_pose(bodies, collider.body))
        found += [_placed(drawing, pose) for drawing in collider.shape.draw()]
    return found


def _placed(drawing: dict[str, Any], pose: Pose) -> dict[str, Any]:
    """A drawing moved from the shape's frame to the world's."""
    turned = {
        key: jnp.matmul(pose.rotation, jnp.asarray(drawing[key], pose.rotation.dtype), precision="highest")
        for key in ("center", "direction", "rotation")
        if key in drawing
    }
    return {**drawing, **turned, "center": pose.position + turned.get("center", 0.0)}


__all__ = ["drawings"]
