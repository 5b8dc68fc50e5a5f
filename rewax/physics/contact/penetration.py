"""How deep points lie inside colliders."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from rewax.physics.contact.colliders import Collider, runs, shape_pose, stacked
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes.solid import distance_to
from rewax.types import Array


def penetration(colliders: Sequence[Collider], bodies: Pose, position: Vec3) -> Array:
    """Greatest depth of any point inside any collider [m], shape (); below 0 where all points are outside.

    Args:
      colliders: the shapes.
      bodies: poses of all bodies, shapes (num_bodies, 3) and (num_bodies, 3, 3).
      position: of the points [m], components of shape (num_points,).

    Gradient: none.
    """

    def depth(collider: Collider, pose: Pose) -> Array:
        from_center = cp.vector(lambda i: position[i] - pose.position[i])
        local = cp.matvec(cp.split_matrix(pose.rotation.T), from_center)
        return -jnp.min(distance_to(collider.shape, local)[0])

    deepest = [jnp.full((), -jnp.inf, position[0].dtype)]
    for where in runs(colliders):
        run = colliders[where]
        poses = stacked([shape_pose(c, Pose(*(a[c.body] for a in bodies))) for c in run])
        depths = jax.vmap(depth)(stacked([c.replace(body=0) for c in run]), poses)
        deepest.append(jnp.max(depths))
    return jax.lax.stop_gradient(jnp.max(jnp.stack(deepest)))
