"""Geoms of a rigid model as colliders that push particles and vertices; poses of its bodies."""

# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.contact.colliders import Collider
from rewax.physics.numerics.arguments import check_instance, check_plain, real_array
from rewax.physics.numerics.checks import NOT_NEGATIVE, POSITIVE, Number, check_numbers, shown, static_number
from rewax.physics.numerics.pose import Pose
from rewax.physics.numerics.rotations import quaternion_to_matrix
from rewax.physics.rigid.forces import kinematics
from rewax.physics.rigid.mjx_access import mujoco
from rewax.physics.rigid.model import RigidModel
from rewax.physics.rigid.overrides import may_touch
from rewax.physics.shapes import Box, Capsule, Cylinder, Ellipsoid, Shape, Sphere
from rewax.physics.shapes.mesh_sdf import bake_mesh
from rewax.types import Array, Scalar

_Y_TO_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation of the axis: capsules and cylinders lie along y in rewax and along z in MuJoCo."""


def colliders(
    model: RigidModel,
    *,
    friction: Scalar | None = None,
    softness: Scalar | None = None,
    mesh_spacing: float | None = None,
    chosen: Callable[[str, str], bool] | None = None,
) -> tuple[Collider, ...]:
    """One collider per geom that may touch others, in the order of the model; ``Collider.body`` is its body.

    Args:
      model: the bodies. The parameters of its geoms become parameters of the colliders.
      friction: Coulomb coefficient of all colliders [-]; None: that of each geom.
      softness: softness of all colliders [1/m], see ``Collider``.
      mesh_spacing: spacing of the grids to which meshes are baked [m]; required if there are meshes. The collider is
        the mesh itself, not its convex hull.
      chosen: ``chosen(name of the body, name of the geom)`` returns whether to include a geom; None: include geoms with
        a contype or conaffinity other than 0, and those of explicit pairs (``<contact><pair/></contact>``).

    Raises:
      ValueError: a geom is a plane (use a wall or a ground), a height field or another kind without a distance; meshes
        without ``mesh_spacing``; an illegal friction, softness or spacing.

    Gradient: exact with respect to ``friction``, ``softness`` and the model's ``geom_size``, ``geom_pos``,
      ``geom_quat`` and ``geom_friction``; none with respect to the size of a mesh.

    Example:
      >>> model = rigid.load("hand.xml", dt=1e-3)  # doctest: +SKIP
      >>> tools = rigid.colliders(model, friction=0.5)  # doctest: +SKIP
      >>> poses = rigid.poses(model, qpos)  # qpos: (num_substeps + 1, num_positions)  # doctest: +SKIP
    """
    check_instance("model", model, RigidModel, "give a model that rigid.load returned")
    _check_options(friction, softness, mesh_spacing, chosen)
    mj, found = model.static.mj, []
    may = may_touch(mj)
    for geom in range(mj.ngeom):
        body, name = mj.body(int(mj.geom_bodyid[geom])).name, mj.geom(geom).name
        touches = may[geom] if chosen is None else chosen(body, name)
        if not touches:
            continue
        shape, along = geom_shape(model, geom, mesh_spacing)
        rotation = quaternion_to_matrix(model.parameters["geom_quat"][geom])
        own = model.parameters["geom_friction"][geom, 0] if friction is None else jnp.asarray(friction)
        found.append(
            Collider(
                shape=shape,
                offset=model.parameters["geom_pos"][geom],
                rotation=rotation @ jnp.asarray(along, rotation.dtype),
                friction=own,
                softness=None if softness is None else jnp.asarray(softness),
                body=int(mj.geom_bodyid[geom]),
            )
        )
    return tuple(found)


def poses(model: RigidModel, qpos: Array) -> Pose:
    """Poses of all bodies for joint positions [m, rad] of shape (..., num_positions).

    Returns:
      Positions [m], shape (..., num_bodies, 3), and rotations, shape (..., num_bodies, 3, 3).

    Raises:
      ValueError: ``qpos`` has another shape or holds no real numbers.

    Gradient: exact.
    """
    check_instance("model", model, RigidModel, "give a model that rigid.load returned")
    qpos = jnp.asarray(real_array("qpos", qpos, "give joint positions, such as state.qpos"))
    if qpos.shape[-1:] != (model.num_positions,):
        raise ValueError(f"qpos has shape {qpos.shape}: give shape (..., {model.num_positions}), as in the model")
    one = qpos.reshape(-1, qpos.shape[-1])
    found = jax.vmap(lambda q: kinematics(model, q))(one)
    return Pose(*(a.reshape(*qpos.shape[:-1], *a.shape[1:]) for a in (found.position, found.rotation)))


def _check_options(friction: Any, softness: Any, mesh_spacing: Any, chosen: Any) -> None:
    rules = (
        ("friction", friction, NOT_NEGATIVE, "give a Coulomb coefficient"),
        ("softness", softness, POSITIVE, "give a decay per metre"),
    )
    for name, value, legal, remedy in rules:
        if value is not None:
            check_plain(name, value, remedy)
            check_numbers([Number(name, value, legal, remedy, ())])
    if mesh_spacing is not None:
        remedy = "give the spacing of a grid in metres"
        check_plain("mesh_spacing", mesh_spacing, remedy)
        static_number("mesh_spacing", mesh_spacing, POSITIVE, remedy)
    if chosen is not None and not callable(chosen):
        raise ValueError(f"chosen is {shown(chosen)}: give a function of the names of body and geom")


def geom_shape(model: RigidModel, geom: int, mesh_spacing: float | None = None) -> tuple[Shape, np.ndarray]:
    """A geom's shape, and the rotation from the shape's frame to the geom's, shape (3, 3).

    Args:
      model: the bodies; the geom's size becomes a leaf of the shape.
      geom: its index.
      mesh_spacing: of the grid to which a mesh is baked [m].

    Raises:
      ValueError: as for ``colliders``.
    """
    mj, size = model.static.mj, model.parameters["geom_size"][geom]
    kinds, straight = mujoco.mjtGeom, np.eye(3)
    match kinds(mj.geom_type[geom]):
        case kinds.mjGEOM_SPHERE:
            return Sphere(radius=size[0]), straight
        case kinds.mjGEOM_CAPSULE:
            return Capsule(radius=size[0], half_length=size[1]), _Y_TO_Z
        case kinds.mjGEOM_CYLINDER:
            return Cylinder(radius=size[0], half_length=size[1]), _Y_TO_Z
        case kinds.mjGEOM_BOX:
            return Box(half_size=size), straight
        case kinds.mjGEOM_ELLIPSOID:
            return Ellipsoid(semi_axes=size), straight
        case kinds.mjGEOM_MESH:
            if mesh_spacing is None:
                raise ValueError(f"{_name(mj, geom)} is a mesh: give mesh_spacing, the spacing of its baked grid in m")
            return bake_mesh(_Mesh(mj, int(mj.geom_dataid[geom])), mesh_spacing), straight
    kind = kinds(mj.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
    raise ValueError(
        f"{_name(mj, geom)} is a {kind}, which is no collider: leave it out with chosen=..., and use a Wall "
        "(particles) or a Ground (tetrahedra) for a plane"
    )


class _Mesh:
    """A mesh of a model with the attributes that ``bake_mesh`` reads."""

    def __init__(self, mj: mujoco.MjModel, mesh: int) -> None:
        first, count = mj.mesh_vertadr[mesh], mj.mesh_vertnum[mesh]
        self.vertices = np.asarray(mj.mesh_vert[first : first + count], float)
        first, count = mj.mesh_faceadr[mesh], mj.mesh_facenum[mesh]
        self.faces = np.asarray(mj.mesh_face[first : first + count])


def _name(mj: mujoco.MjModel, geom: int) -> str:
    name = mj.geom(geom).name
    return f"geom {name!r}" if name else f"geom number {geom}"


__all__ = ["colliders", "geom_shape", "poses"]
