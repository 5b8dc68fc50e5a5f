"""Articulated bodies as a camera sees them: the geoms of a model."""

from typing import TypeVar

import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics.pose import Pose, body_pose, product, turned
from rewax.physics.rigid import RigidModel, RigidState, body_name, body_poses, geom_poses
from rewax.physics.rigid.geom_colliders import geom_shape
from rewax.physics.rigid.queries import geom_kind, geom_mesh, shown_geoms
from rewax.physics.shapes import Plane
from rewax.sensors.world import Solid, Triangles, World

_Y_TO_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_UNSEEN = ("hfield", "sdf")

T = TypeVar("T", Solid, Triangles)


def with_robot(world: World, model: RigidModel, state: RigidState) -> World:
    """The world with the geoms of a model; its bodies are the model's. Gradient: exact.

    A body named like something in the world gets ``_2`` after its name, so that each has a mask of its own.
    """
    (seen, surfaces), taken = see_robot(model, state), world.names

    def renamed(part: T) -> T:
        return part.replace(name=f"{part.name}_2") if part.name in taken else part

    return world.replace(
        solids=(*world.solids, *map(renamed, seen)),
        triangles=(*world.triangles, *map(renamed, surfaces)),
        bodies=body_poses(model, state),
    )


def see_robot(model: RigidModel, state: RigidState) -> tuple[tuple[Solid, ...], tuple[Triangles, ...]]:
    """The geoms that pictures show; each has the name of its body (``world`` for what is fixed to the world).

    Meshes are seen as their triangles, planes without an end, whatever their size. Height fields and geoms of the type
    ``sdf`` are not seen.

    Args:
      model: the bodies.
      state: where they are.

    Gradient: exact, by positions and sizes.
    """
    mj, poses = model.static.mj, geom_poses(model, state)
    solids, surfaces = [], []
    for geom in shown_geoms(model):
        kind, pose = geom_kind(model, geom), body_pose(poses, geom)
        name = body_name(model, int(mj.geom_bodyid[geom]))
        if kind in _UNSEEN:
            continue
        if kind == "mesh":
            vertices, faces = geom_mesh(model, geom)
            corners = pose.position + turned(pose.rotation, jnp.asarray(vertices, pose.position.dtype))
            surfaces.append(Triangles(vertices=corners, faces=jnp.asarray(faces, jnp.int32), name=name))
            continue
        shape, along = (Plane(), _Y_TO_Z) if kind == "plane" else geom_shape(model, geom)
        rotation = product(pose.rotation, jnp.asarray(along, pose.rotation.dtype))
        solids.append(Solid(shape=shape, pose=Pose(pose.position, rotation), name=name))
    return tuple(solids), tuple(surfaces)


__all__ = ["see_robot", "with_robot"]
