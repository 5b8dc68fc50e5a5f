"""Solids in a picture: rays against shapes, all shapes of one kind at once."""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp

from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.shapes.solid import distance_to
from rewax.sensors.hits import Hits, Rays
from rewax.sensors.world import NOTHING, Solid
from rewax.struct import Structure
from rewax.types import Array


def see_solids(solids: Sequence[Solid], labels: Mapping[str, int], rays: Rays, *, everything: bool) -> list[Hits]:
    """First hits of rays with solids, one ``Hits`` for each kind of shape.

    Args:
      solids: shapes at their places.
      labels: by name.
      rays: of a camera.
      everything: labels and normals too.

    Gradient: of depth by poses and sizes, exact on the surface that is met.
    """

    groups: dict[tuple, list[Solid]] = {}
    for solid in solids:
        leaves, treedef = jax.tree.flatten(solid.shape)
        groups.setdefault((Structure.of(treedef), tuple(jnp.shape(leaf) for leaf in leaves)), []).append(solid)
    return [_see_kind(group, labels, rays, everything=everything) for group in groups.values()]


def _see_kind(group: list[Solid], labels: Mapping[str, int], rays: Rays, *, everything: bool) -> Hits:
    """All solids with shapes of one kind."""
    shape, pose = (
        jax.tree.map(lambda *a: jnp.stack(a), *(getattr(s, name) for s in group)) for name in ("shape", "pose")
    )

    def cast(shape, pose) -> Array:
        origin, direction = _in_frame(pose, rays)
        depth = shape.cast(origin, direction)
        return jnp.where(depth > rays.near, depth, jnp.inf)

    depth = jax.vmap(cast)(shape, pose)
    if not everything:
        return Hits(depth.min(axis=0))
    which = depth.argmin(axis=0)
    best = jnp.take_along_axis(depth, which[None], axis=0)[0]

    def normal(shape, pose) -> Vec3:
        origin, direction = _in_frame(pose, rays)
        met = jnp.where(jnp.isfinite(best), best, 0.0)
        _, local = distance_to(shape, cp.vector(lambda i: origin[i] + met * direction[i]))
        rotation = cp.split_matrix(pose.rotation)
        return cp.vector(lambda i: cp.dot(rotation[i], local))

    normals = jax.vmap(normal)(shape, pose)
    names = jnp.asarray([labels[solid.name] for solid in group], jnp.int32)
    return Hits(
        depth=best,
        label=jnp.where(jnp.isfinite(best), names[which], NOTHING),
        normal=cp.vector(lambda i: jnp.take_along_axis(normals[i], which[None], axis=0)[0]),
    )


def _in_frame(pose, rays: Rays) -> tuple[Vec3, Vec3]:
    """Origin and directions of rays in a shape's frame."""
    rotation = cp.split_matrix(pose.rotation)
    offset = cp.subtract(rays.origin, cp.split_vector(pose.position))
    inverse = cp.transpose(rotation)
    start = cp.matvec(inverse, offset)
    direction = cp.matvec(inverse, rays.direction)
    return cp.vector(lambda i: jnp.broadcast_to(start[i], direction[i].shape)), direction
