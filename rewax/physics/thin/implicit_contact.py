"""Contact in an implicit step of cloth and ropes, with ground, colliders and itself: slope, curvature, blocks.

The normal force depends on the distance d at the end of the step and on its rate (d - d_0) / dt since the beginning. It
acts along the gradient of the distance, so it has a potential. Friction takes the normal force, the normal and the
closest points of the beginning. Its force depends on the sliding distance u of the step:
min(friction_damping |u| / dt, friction f_n) against u.

Source of the lagged friction: Li et al. 2020, "Incremental potential contact", section 5.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from rewax.lowering.kernels import joined, pointwise, separated
from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.penalty import PenaltyContact, penalty_response, surface
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.thin.newton import Blocks, Linear
from rewax.types import Array, Scalar, Vector

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene


class Sliding(NamedTuple):
    """Friction of a step, arrays (num_vertices,) or (num_pairs,)."""

    normal: Vec3
    """Normal at the beginning."""
    limit: Array
    """Coulomb's limit [N]."""
    grip: Array
    """Force per sliding speed below the limit [N s/m]."""


class Touch(NamedTuple):
    """A surface at the beginning of a step."""

    distance: Array
    moved: Vec3
    """Positions of the vertices if they stuck to the surface during the step [m]."""
    sliding: Sliding


class Surface(NamedTuple):
    """A surface during a step: a collider with the poses of its body at both ends, or the plane normal . x = height."""

    collider: Collider | None
    poses: tuple[Pose, Pose] | None
    plane: tuple[Vector, Scalar] | None
    friction: Scalar


def surfaces(scene: "ThinScene", poses: tuple[Pose, Pose]) -> list[Surface]:
    """The ground and the colliders of a scene."""
    found, contact, ground = [], scene.contact, scene.ground
    if contact is None:
        return found
    if ground is not None:
        found.append(Surface(None, None, (ground.normal, ground.height), contact.friction))
    for collider in scene.colliders:
        start, end = (body_pose(pose, collider.body) for pose in poses)
        found.append(Surface(collider.replace(body=0), (start, end), None, collider.friction))
    return found


def touch(contact: PenaltyContact, place: Surface, x: Vec3, v: Vec3, dt: float) -> Touch:
    """The surface at the beginning of a step with vertices at x [m] with velocities v [m/s]. Gradient: exact."""
    shared, (own, friction) = separated((contact, place.friction))
    known = (shared[0], shared[1], place._replace(friction=0.0), jnp.asarray(dt))
    return _touch(known, (own, friction, x, v))


@pointwise
def _touch(shared: Any, given: Any) -> Touch:
    (contact, friction, place, dt), (own, own_friction, x, v) = shared, given
    contact, friction = joined(contact, own), joined(friction, own_friction)
    if place.collider is None:
        n = _plane_normal(place)
        distance, moved = cp.dot(n, x) - place.plane[1], x
    else:
        before, after = place.poses
        distance, n, in_body = surface(place.collider, x, before)
        turned = cp.matvec(cp.split_matrix(after.rotation - before.rotation), in_body)
        moved = cp.vector(lambda i: x[i] + turned[i] + (after.position[i] - before.position[i]))
    relative = cp.vector(lambda i: v[i] - (moved[i] - x[i]) / dt)
    response = penalty_response(contact, distance, n, relative, 0.0)
    grip = jnp.where(response.gap < 0, _share(contact, response.gap) * contact.friction_damping, 0.0)
    n = cp.vector(lambda i: jnp.broadcast_to(n[i], distance.shape))
    return Touch(distance, moved, Sliding(n, friction * response.push, grip))


def touch_slope(contact: PenaltyContact, place: Surface, at: Touch, x: Vec3, dt: float) -> Vec3:
    """Minus the force of a surface on vertices at x at the end of the step [N]. Gradient: exact."""
    shared, own = separated(contact)
    return _touch_slope((shared, place._replace(friction=0.0), jnp.asarray(dt)), (own, at, x))


@pointwise
def _touch_slope(shared: Any, given: Any) -> Vec3:
    (contact, place, dt), (own, at, x) = shared, given
    distance, n = _at_end(place, x)
    push = _push(joined(contact, own), at.distance, dt, distance)
    slid = friction_slope(at.sliding, cp.subtract(x, at.moved), dt)
    return cp.vector(lambda i: slid[i] - push * n[i])


def touch_curvature(contact: PenaltyContact, place: Surface, at: Touch, x: Vec3, dt: float, exact: Array) -> Linear:
    """The product with the derivative of ``touch_slope``; the normal is fixed if ``exact`` is 0. Gradient: none."""
    shared, own = separated(contact)
    known = (shared, place._replace(friction=0.0), jnp.asarray(dt), exact)
    return lambda p: _touch_product(known, (own, at, x, p))


@pointwise
def _touch_product(shared: Any, given: Any) -> Vec3:
    (contact, place, dt, exact), (own, at, x, p) = shared, given
    contact = joined(contact, own)
    distance, n = _at_end(place, x)
    push, less = jax.jvp(lambda d: _push(contact, at.distance, dt, d), (distance,), (cp.dot(n, p),))
    _, turned = jax.jvp(lambda x: _at_end(place, x)[1], (x,), (p,))
    u = cp.subtract(x, at.moved)
    _, slid = jax.jvp(lambda u: friction_slope(at.sliding, u, dt), (u,), (p,))
    return cp.vector(lambda i: slid[i] - less * n[i] - exact * push * turned[i])


def touch_blocks(contact: PenaltyContact, place: Surface, at: Touch, x: Vec3, dt: float) -> Blocks:
    """The blocks on the diagonal of the positive definite curvature. Gradient: none."""
    shared, own = separated(contact)
    return _touch_blocks((shared, place._replace(friction=0.0), jnp.asarray(dt)), (own, at, x))


@pointwise
def _touch_blocks(shared: Any, given: Any) -> Blocks:
    (contact, place, dt), (own, at, x) = shared, given
    contact = joined(contact, own)
    distance, n = _at_end(place, x)
    _, less = jax.jvp(lambda d: _push(contact, at.distance, dt, d), (distance,), (jnp.ones_like(distance),))
    stick = friction_stiffness(at.sliding, cp.subtract(x, at.moved), dt)
    m = at.sliding.normal

    def entry(i: int, j: int) -> Array:
        return -less * n[i] * n[j] + stick * (float(i == j) - m[i] * m[j])

    return Blocks(cp.vector(lambda i: entry(i, i)), cp.vector(lambda i: entry((i + 1) % 3, (i + 2) % 3)))


# --- Laws -------------------------------------------------------------------------------------------------------------


def friction_slope(sliding: Sliding, u: Vec3, dt: Array) -> Vec3:
    """Minus the force of friction after a relative displacement u [N].

    Gradient: exact; at a Coulomb limit above 0 that of sticking.
    """
    along = _tangential(sliding.normal, u)
    return cp.scale(friction_stiffness(sliding, u, dt), along)


def friction_stiffness(sliding: Sliding, u: Vec3, dt: Array) -> Array:
    """Force of friction over the sliding distance [N/m]."""
    along = _tangential(sliding.normal, u)
    square = cp.dot(along, along)
    slides = sliding.grip * cp.safe_sqrt(square) > sliding.limit * dt
    held = jnp.where(sliding.limit > 0, sliding.grip / dt, 0.0)
    return jnp.where(slides, sliding.limit / jnp.sqrt(jnp.where(slides, square, 1.0)), held)


def _tangential(n: Vec3, u: Vec3) -> Vec3:
    normal = cp.dot(n, u)
    return cp.vector(lambda i: u[i] - normal * n[i])


def _push(contact: PenaltyContact, start: Array, dt: Array, distance: Array) -> Array:
    """Normal force at a distance [N], ``penalty.penalty_force`` with the rate of the distance."""
    gap, approach = distance - contact.radius, jnp.maximum((start - distance) / dt, 0.0)
    damping = _share(contact, gap) * contact.damping - contact.depth_damping * gap
    return jnp.where(gap < 0, damping * approach - contact.stiffness * gap, 0.0)


def _share(contact: PenaltyContact, gap: Array) -> Array:
    """Share of both dampings at a depth, see ``penalty.penalty_force``."""
    gradual = jnp.asarray(contact.onset) > 0
    return jnp.where(gradual, jnp.clip(-gap / jnp.where(gradual, contact.onset, 1.0), 0.0, 1.0), 1.0)


def _at_end(place: Surface, x: Vec3) -> tuple[Array, Vec3]:
    """Distance of the surface at the end of the step, and its gradient, so that the force has a potential.

    The normal of an exact shape is this gradient. That of another one has length 1, and its distance may not.
    """
    if place.collider is None:
        n = _plane_normal(place)
        assert place.plane is not None
        return cp.dot(n, x) - place.plane[1], n
    assert place.poses is not None
    collider, end = place.collider, place.poses[1]
    if collider.shape.is_exact:
        distance, normal, _ = surface(collider, x, end)
        return distance, normal
    distance, pull = jax.vjp(lambda x: surface(collider, x, end)[0], x)
    return distance, pull(jnp.ones_like(distance))[0]


def _plane_normal(place: Surface) -> Vec3:
    assert place.plane is not None
    n = place.plane[0]
    return (n[0], n[1], n[2])


__all__ = [
    "Sliding", "Surface", "Touch", "friction_slope", "friction_stiffness", "surfaces", "touch", "touch_blocks",
    "touch_curvature", "touch_slope",
]  # fmt: skip
