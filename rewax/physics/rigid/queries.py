"""Quantities of a state: poses, velocities, shapes to draw, distances."""

# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics.pose import Pose
from rewax.physics.rigid.forces import (
    attached,
    contacts,
    kinematics,
    mjx_data,
)
from rewax.physics.rigid.kinematics import body_velocities as spatial_velocities
from rewax.physics.rigid.kinematics import point_velocities
from rewax.physics.rigid.mjx_access import mujoco
from rewax.physics.rigid.model import RigidModel, RigidState, check_state
from rewax.types import Array


def body_poses(model: RigidModel, state: RigidState) -> Pose:
    """Origin [m] and orientation of every body's frame, shapes (num_bodies, 3) and (num_bodies, 3, 3).

    Gradient: exact.

    Raises:
      ValueError: the state is not one of this model.
    """
    check_state(model, state)
    kin = kinematics(model, state.qpos)
    return Pose(kin.position, kin.rotation)


def geom_poses(model: RigidModel, state: RigidState) -> Pose:
    """Center [m] and orientation of every geom, shapes (num_geoms, 3) and (num_geoms, 3, 3). Gradient: exact.

    Raises:
      ValueError: the state is not one of this model.
    """
    check_state(model, state)
    kin = kinematics(model, state.qpos)
    return attached(kin, model.static.mj.geom_bodyid, model.parameters["geom_pos"], model.parameters["geom_quat"])


def body_velocities(model: RigidModel, state: RigidState) -> tuple[Array, Array]:
    """Velocity of each body's origin [m/s] and angular velocity [rad/s], world axes, shape (num_bodies, 3) each.

    Gradient: exact.

    Raises:
      ValueError: the state is not one of this model.
    """
    check_state(model, state)
    kin = kinematics(model, state.qpos)
    twist = spatial_velocities(model.static.topology, kin, state.qvel)
    return point_velocities(kin, twist, jnp.arange(model.num_bodies), kin.position), twist[:, :3]


def centers_of_mass(model: RigidModel, state: RigidState) -> Array:
    """Center of mass of each body's subtree [m], shape (num_bodies, 3); row 0: of all bodies. Gradient: exact.

    Raises:
      ValueError: the state is not one of this model.
    """
    check_state(model, state)
    return kinematics(model, state.qpos).subtree_com


def shapes(model: RigidModel, state: RigidState) -> list[dict[str, Any]]:
    """Shapes of the geoms to draw; ``rewax.viz.shapes`` has a table of their keys.

    Height fields and geoms of ``type="sdf"`` are left out. Geoms of groups 3 to 5, which MuJoCo's viewer hides, are
    left out if their body has other geoms. Every call returns the same NumPy arrays for meshes.

    Gradient: exact with respect to positions and sizes; meshes are constants.

    Raises:
      ValueError: the state is not one of this model.
    """
    check_state(model, state)
    pose, found = geom_poses(model, state), []
    for geom in shown_geoms(model):
        kind = geom_kind(model, geom)
        size, rotation = model.parameters["geom_size"][geom], pose.rotation[geom]
        shape = {"kind": kind, "center": pose.position[geom]}
        if kind == "plane":
            found.append({**shape, "direction": rotation[:, 2]})
        elif kind == "sphere":
            found.append({**shape, "radius": size[0]})
        elif kind in ("capsule", "cylinder"):
            found.append({**shape, "radius": size[0], "half_length": size[1], "direction": rotation[:, 2]})
        elif kind == "box":
            found.append({**shape, "rotation": rotation, "half_size": size})
        elif kind == "ellipsoid":
            found.append({**shape, "rotation": rotation, "semi_axes": size})
        elif kind == "mesh":
            vertices, triangles = geom_mesh(model, geom)
            found.append({**shape, "rotation": rotation, "vertices": vertices, "triangles": triangles})
    return found


def shown_geoms(model: RigidModel) -> list[int]:
    """Indices of the geoms that pictures show: all but those of the groups 3 to 5 of a body that has others."""
    mj = model.static.mj
    hidden = mj.geom_group > 2
    shown = set(mj.geom_bodyid[~hidden])
    return [geom for geom in range(mj.ngeom) if not (hidden[geom] and mj.geom_bodyid[geom] in shown)]


def geom_kind(model: RigidModel, geom: int) -> str:
    """``"sphere"``, ``"box"``, ``"mesh"`` ...: MuJoCo's name of the geom's type."""
    return mujoco.mjtGeom(model.static.mj.geom_type[geom]).name.removeprefix("mjGEOM_").lower()


def geom_mesh(model: RigidModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [m] and triangles of a geom that is a mesh, in the geom's frame."""
    return _mesh(model.static, int(model.static.mj.geom_dataid[geom]))


@functools.lru_cache(maxsize=256)
def _mesh(static: Any, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [m] and triangles of a mesh of the model, in the frame of its geoms."""
    mj = static.mj
    vertices, triangles = (
        slice(first[mesh], first[mesh] + count[mesh])
        for first, count in ((mj.mesh_vertadr, mj.mesh_vertnum), (mj.mesh_faceadr, mj.mesh_facenum))
    )
    return np.array(mj.mesh_vert[vertices]), np.array(mj.mesh_face[triangles])


def body_name(model: RigidModel, body: int) -> str:
    """The name of a body; ``body_3`` for body 3 if it has none."""
    return model.static.mj.body(body).name or f"body_{body}"


def touching_bodies(model: RigidModel) -> dict[str, int]:
    """Bodies by name that have geoms in pairs that may touch; ``world`` among them if fixed geoms are."""
    mj, groups = model.static.mj, model.static.collisions.groups
    geoms = [np.asarray(group.geoms).ravel() for group in groups]
    geoms += [
        np.asarray(pair).ravel()
        for found in (model.static.sphere_boxes, model.static.capsules, model.static.boxes)
        for pair in found[1:]
    ]
    bodies = np.unique(mj.geom_bodyid[np.concatenate([np.zeros(0, int), *geoms]).astype(int)])
    return {body_name(model, int(body)): int(body) for body in bodies}


def contact_distances(model: RigidModel, state: RigidState, *, body: str | None = None) -> Array:
    """Signed distances of all pairs that may touch [m], negative inside, shape (num_contacts,); 1 in unused slots.

    Args:
      model: the bodies.
      state: their state.
      body: name of a body; pairs without it get distance 1. None: all pairs.

    Raises:
      ValueError: the state is not one of this model, or there is no such body. The message lists the known names.

    Gradient: that of the contact functions, see ``ContactPair``; MJX's own for kinds that MJX collides.
    """
    check_state(model, state)
    m, d = mjx_data(model, kinematics(model, state.qpos), state, jnp.zeros(model.num_actuators, state.qpos.dtype))
    found = contacts(model, m, d)
    if body is None:
        return found.distance
    touches = jnp.any(jnp.asarray(model.static.mj.geom_bodyid)[found.geoms] == model.body(body), axis=-1)
    return jnp.where(touches, found.distance, 1.0)
