"""Penalty forces of the ground and of moving shapes on vertices."""

from typing import NamedTuple

import jax.numpy as jnp

from rewax import struct
from rewax.lowering.kernels import joined, pointwise, separated
from rewax.physics.contact.colliders import Collider
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, POSITIVE
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes.solid import distance_to
from rewax.types import Array, Scalar, Vector


@struct.dataclass
class PenaltyContact(struct.Replaceable):
    """Penalty law of contact. Parameters are numbers, or arrays of shape (num_vertices,).

    Attributes:
      stiffness: normal force per penetration [N/m], > 0.
      damping: normal force per approaching speed [N s/m], >= 0.
      friction_damping: tangential force per sliding speed below Coulomb's limit [N s/m], >= 0, and > 0 where the ground
        or a collider has friction. Explicit integration resolves up to about one vertex mass per dt; far above it,
        sliding reverses at Coulomb's limit.
      friction: Coulomb coefficient [-] of the ground, >= 0; colliders have their own.
      radius: a vertex touches when its distance is below this [m], >= 0.
      onset: depth over which both dampings rise to their full value [m]; 0: immediately.
      depth_damping: additional normal force per depth and approaching speed [N s/m^2], >= 0 (Hunt and Crossley's law,
        without a step at the onset).
    """

    stiffness: Scalar = struct.number(POSITIVE, "give a force per penetration in N/m")
    damping: Scalar = struct.number(NOT_NEGATIVE, "give a number of N s/m", default=0.0)
    friction_damping: Scalar = struct.number(NOT_NEGATIVE, "give a number of N s/m", default=0.0)
    friction: Scalar = struct.number(NOT_NEGATIVE, "give a Coulomb coefficient, 0 for none", default=0.0)
    radius: Scalar = struct.number(NOT_NEGATIVE, "give a number of m", default=0.0)
    onset: Scalar = struct.number(NOT_NEGATIVE, "give a number of m", default=0.0)
    depth_damping: Scalar = struct.number(NOT_NEGATIVE, "give a number of N s/m^2", default=0.0)


@struct.dataclass
class Ground(struct.Replaceable):
    """The solid half-space normal . x < height.

    Attributes:
      normal: unit vector pointing out [-], shape (3,).
      height: distance of its surface from the origin along the normal [m].
    """

    normal: Vector = struct.number(FINITE, "give a unit vector, (0, 1, 0) for y up", shape=(3,))
    height: Scalar = struct.number(FINITE, "give a distance in metres", shape=(), default=0.0)


def ground_force(ground: Ground, contact: PenaltyContact, x: Vec3, v: Vec3) -> Vec3:
    """Force of the ground on vertices [N], see ``penalty_force``.

    Args:
      ground: the plane.
      contact: the law.
      x, v: positions [m] and velocities [m/s], components of shape (num_vertices,).

    Returns:
      Force on each vertex [N], components of shape (num_vertices,).

    Gradient: exact with respect to positions, velocities, ground and parameters; see ``penalty_force``.
    """
    shared, own = separated(contact)
    return _ground_force((ground, shared), (own, x, v))


@pointwise
def _ground_force(shared: tuple[Ground, PenaltyContact], vertices: tuple[PenaltyContact, Vec3, Vec3]) -> Vec3:
    (ground, contact), (own, x, v) = shared, vertices
    contact = joined(contact, own)
    n = (ground.normal[0], ground.normal[1], ground.normal[2])
    return penalty_force(contact, cp.dot(n, x) - ground.height, n, v, contact.friction)


def collider_force(
    collider: Collider, contact: PenaltyContact, x: Vec3, v: Vec3, before: Pose, after: Pose, dt: float
) -> Vec3:
    """Force of a moving shape on vertices [N], see ``penalty_force``.

    Args:
      collider: the shape and its friction; its softness does not count here.
      contact: the law.
      x, v: positions [m] and velocities [m/s], components of shape (num_vertices,).
      before, after: pose of its body at the beginning and end of the substep, shapes (3,), (3, 3). Distance and normal
        are those at the beginning. The surface's velocity is the displacement of its point over dt.
      dt: duration of the substep [s].

    Returns:
      Force on each vertex [N], components of shape (num_vertices,).

    Gradient: exact with respect to positions, velocities, poses, sizes and parameters; see ``penalty_force``.
    """
    shared, own = separated(contact)
    return _collider_force((collider.replace(body=0), shared, before, after, dt), (own, x, v))


@pointwise
def _collider_force(
    shared: tuple[Collider, PenaltyContact, Pose, Pose, Scalar], vertices: tuple[PenaltyContact, Vec3, Vec3]
) -> Vec3:
    (collider, contact, before, after, dt), (own, x, v) = shared, vertices
    contact = joined(contact, own)
    distance, normal, in_body = surface(collider, x, before)
    # Difference poses first: a resting body's surface velocity is exactly 0.
    turned = cp.matvec(cp.split_matrix((after.rotation - before.rotation) / dt), in_body)
    shift = (after.position - before.position) / dt
    relative = cp.vector(lambda i: v[i] - turned[i] - shift[i])
    return penalty_force(contact, distance, normal, relative, collider.friction)


def surface(collider: Collider, x: Vec3, body: Pose) -> tuple[Array, Vec3, Vec3]:
    """Distance, normal and body coordinates of vertices at a shape.

    Args:
      collider: the shape.
      x: positions [m], components of shape (num_vertices,).
      body: pose of its body, shapes (3,), (3, 3).

    Returns:
      Signed distances [m], unit normals away from the shape in the world's frame, and positions in the body's frame
      [m]. Gradient: exact with respect to positions, pose and sizes.
    """
    rotation = cp.split_matrix(body.rotation)
    in_body = cp.matvec(cp.transpose(rotation), cp.vector(lambda i: x[i] - body.position[i]))
    own = cp.split_matrix(collider.rotation)
    local = cp.matvec(cp.transpose(own), cp.vector(lambda i: in_body[i] - collider.offset[i]))
    distance, normal = distance_to(collider.shape, local)
    return distance, cp.matvec(rotation, cp.matvec(own, normal)), in_body


def penalty_force(contact: PenaltyContact, distance: Array, normal: Vec3, velocity: Vec3, friction: Scalar) -> Vec3:
    """Force on vertices near a surface [N], components.

    With c = distance - radius < 0, v_n the normal and v_t the tangential velocity:
    f = n f_n - v_t/|v_t| min(friction_damping |v_t|, friction |f_n|),
    f_n = -stiffness c - (damping - depth_damping c) min(v_n, 0),
    where damping and friction_damping are multiplied by min(-c / onset, 1).

    Args:
      contact: the law.
      distance: signed distance from the surface [m].
      normal: unit vectors pointing out of it [-], components.
      velocity: velocity of vertices relative to the surface [m/s], components.
      friction: Coulomb coefficient [-].

    Gradient: exact, finite at rest. Without an onset, damping and friction start with a step where the vertex touches:
      no derivative sees its height, damping |v_n|. At a Coulomb limit above 0 the derivative is that of sticking.
    Source: NVIDIA Warp's contact of particles with the ground; damping by depth as in DiffRL's dflex.
    """
    push, drag, v_t, *_ = penalty_response(contact, distance, normal, velocity, friction)
    return cp.vector(lambda i: push * normal[i] - drag * v_t[i])


class PenaltyResponse(NamedTuple):
    """The parts of ``penalty_force``, arrays of shape (num_vertices,)."""

    push: Array
    """Normal force [N], >= 0."""
    drag: Array
    """Tangential force per sliding speed [N s/m]."""
    sliding: Vec3
    """Tangential velocity relative to the surface [m/s]."""
    separating: Array
    """Normal velocity relative to the surface, negative while vertices approach [m/s]."""
    gap: Array
    """Distance minus radius [m], negative where vertices touch."""
    damping: Array
    """Normal force per approaching speed [N s/m]."""


def penalty_response(
    contact: PenaltyContact, distance: Array, normal: Vec3, velocity: Vec3, friction: Scalar
) -> PenaltyResponse:
    """The parts of ``penalty_force``; same arguments, same gradient."""
    c = distance - contact.radius
    v_n = cp.dot(normal, velocity)
    gradual = jnp.asarray(contact.onset) > 0
    share = jnp.where(gradual, jnp.clip(-c / jnp.where(gradual, contact.onset, 1.0), 0.0, 1.0), 1.0)
    damping = share * contact.damping - contact.depth_damping * c
    push = jnp.where(c < 0, -contact.stiffness * c - damping * jnp.minimum(v_n, 0.0), 0.0)
    v_t = cp.vector(lambda i: velocity[i] - v_n * normal[i])
    limit = friction * push
    square = cp.dot(v_t, v_t)
    friction_damping = share * contact.friction_damping
    slides = friction_damping * cp.safe_sqrt(square) > limit
    speed = jnp.sqrt(jnp.where(slides, square, 1.0))
    # A limit of 0 allows no drag at rest either, where nothing slides.
    drag = jnp.where(slides, limit / speed, jnp.where(limit > 0, friction_damping, 0.0))
    return PenaltyResponse(push, drag, v_t, v_n, c, damping)


__all__ = [
    "Ground",
    "PenaltyContact",
    "PenaltyResponse",
    "collider_force",
    "ground_force",
    "penalty_force",
    "penalty_response",
    "surface",
]
