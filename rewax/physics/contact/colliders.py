"""Moving rigid shapes, as conditions on grid velocities."""

import enum
import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.lowering.fusion import compute_once, materialize, stored
from rewax.lowering.kernels import pointwise
from rewax.lowering.recompute import recomputed
from rewax.physics.contact.motion import Placed, at_nodes, chord_motion, placed
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, POSITIVE
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.pose import Pose, placed_at
from rewax.physics.shapes.base import Shape
from rewax.types import Array, Scalar, Vector

T = TypeVar("T")

MIN_INFLUENCE = 0.1
"""A collider acts where its influence exceeds this: within log(10) / softness of its surface."""
REACH_IN_CELLS = 1.0
"""Cells of a grid from which a collider acts whose softness is None."""


@struct.dataclass
class Collider(struct.Replaceable):
    """A rigid shape fixed to a body, which moves as prescribed (``mpm``) or as forces move it (``coupling``).

    Attributes:
      shape: its signed distance, in its own frame.
      offset: origin of the shape's frame in the body's frame [m], shape (3,); by default zero.
      rotation: from the shape's frame to the body's, shape (3, 3); by default not turned.
      friction: Coulomb coefficient [-], >= 0.
      softness: decay of the influence with distance [1/m], > 0; influence = min(exp(-softness * distance), 1). None:
        log(10) / (the grid's spacing), with which it acts from one cell on, see ``with_softness``. The reference's is
        666. It does not count for tetrahedra.
      body: index of the body that carries it (static).
    """

    shape: Shape
    offset: Vector = struct.number(
        FINITE, "give a position in metres", shape=(3,), default_factory=lambda: jnp.zeros(3)
    )
    rotation: Vector = struct.number(FINITE, "give a rotation matrix", shape=(3, 3), default_factory=lambda: jnp.eye(3))
    friction: Scalar = struct.number(NOT_NEGATIVE, "give a Coulomb coefficient, 0 for none")
    softness: Scalar | None = struct.number(
        POSITIVE, "give a decay per metre, or None for a reach of one cell", default=None
    )
    body: int = struct.static_field(default=0)


class Overlap(enum.Enum):
    """How several colliders act on one node."""

    SEQUENTIAL = "sequential"
    """One after the other, in the order of the scene: the last one wins where they overlap. The law of Rewarped."""
    NEAREST = "nearest"
    """Only the one whose surface is nearest (inside several: the one in which the node lies deepest): the colliders
    act like the union of their shapes, in whichever order they are given. With many shapes it is also faster, as the
    law is evaluated once per node."""


class Touch(NamedTuple):
    """A collider at some nodes, arrays of shape (num_nodes,)."""

    distance: Array
    """Signed distance [m]."""
    influence: Array
    """How much the node obeys the collider, min(exp(-softness distance), 1) [-]."""
    normal: Vec3
    """Away from the collider, in the world's frame."""
    friction: Scalar
    """Coulomb coefficient [-], shape () or (num_nodes,)."""
    velocity: Vec3
    """Of the body's material point at the node [m/s]."""


def apply_colliders(
    colliders: Sequence[tuple[Collider, Placed]],
    position: Vec3,
    velocity: Vec3,
    *,
    overlap: Overlap = Overlap.SEQUENTIAL,
) -> Vec3:
    """Node velocities after contact with several moving shapes.

    Args:
      colliders: the shapes, each with its placement in the substep, see ``place``.
      position: where the nodes are [m], components of shape (num_nodes,). Gradient: none.
      velocity: node velocities [m/s], components of shape (num_nodes,).
      overlap: how they act together (static).

    Gradient: as for ``apply_collider``; with ``NEAREST``, where two are equally near, the mean of theirs.
    """
    colliders = [(collider.replace(body=0), placed) for collider, placed in colliders]
    if overlap is Overlap.SEQUENTIAL or len(colliders) < 2:
        if len(colliders) < _LONG_RUN:
            return _in_turn(colliders, position, velocity)
        # XLA for a CPU compiles a kernel for each step of each collider; on a GPU one kernel holds many colliders.
        return jax.lax.platform_dependent(colliders, position, velocity, cpu=_in_loops, default=_in_turn)
    touches = [_touch_of_kind(collider, position, placed) for collider, placed in colliders]
    return contact_velocity(nearest(touches)[0], velocity)


def runs(colliders: Sequence[Collider]) -> list[slice]:
    """Neighbours that can be stacked: shapes of one kind with parameters of the same form, whatever their bodies."""

    def kind(collider: Collider) -> Any:
        leaves, treedef = jax.tree.flatten(collider.replace(body=0))
        return treedef, tuple(jnp.shape(leaf) for leaf in leaves)

    ends = list(itertools.accumulate(len(list(run)) for _, run in itertools.groupby(colliders, kind)))
    return [slice(*ends) for ends in itertools.pairwise([0, *ends])]


def with_softness(colliders: Sequence[Collider], spacing: float) -> tuple[Collider, ...]:
    """Colliders whose softness is known: those that have none act from one cell on.

    With a shorter reach nodes come into contact one after the other, at influences between 0.1 and 1; no derivative
    sees these steps (``benchmarks/particle_contact_gradients.py``).

    Args:
      colliders: of a scene.
      spacing: of its grid [m].
    """
    softness = -math.log(MIN_INFLUENCE) / (REACH_IN_CELLS * spacing)
    return tuple(c.replace(softness=softness) if c.softness is None else c for c in colliders)


def known_softness(collider: Collider) -> Scalar:
    """Softness of a collider [1/m].

    Raises:
      ValueError: it is None, and no grid is known here.
    """
    if collider.softness is None:
        raise ValueError("softness is None, and no grid is known here: give a decay per metre, or use with_softness")
    return collider.softness


def apply_collider(collider: Collider, position: Vec3, velocity: Vec3, before: Pose, after: Pose, dt: float) -> Vec3:
    """Node velocities after contact with one moving shape.

    With d and n the signed distance and normal at a node, v_b the velocity of the body's material point there and
    u = v - v_b: if w = min(exp(-softness d), 1) > 0.1 the velocity becomes v_b + (1 - w) u + w u_t, where
    u_t is u without its approaching normal part, shortened by Coulomb friction.

    Args:
      collider: the shape.
      position: where the nodes are [m], components of shape (num_nodes,). Gradient: none.
      velocity: node velocities [m/s], components of shape (num_nodes,).
      before, after: pose of the collider's body at the beginning and end of the substep, shapes (3,), (3, 3).
      dt: duration of the substep [s].

    Gradient: exact with respect to velocities, poses, friction, softness and the shape's sizes; the onset of contact
      at influence 0.1 is a step that no derivative sees.
    Source: Huang et al. 2021, PlasticineLab, appendix; the law used by Rewarped.
    """
    start, end = shape_pose(collider, before), shape_pose(collider, after)
    return apply_colliders([(collider, placed(start, chord_motion(start, end, dt)))], position, velocity)


def touch(collider: Collider, position: Vec3, placed: Placed) -> Touch:
    """A collider at the given nodes.

    Args:
      collider: the shape.
      position: where the nodes are [m], components of shape (num_nodes,). Gradient: none.
      placed: the shape, without leading axes.

    Gradient: exact.
    """
    # Once where shapes compare places in their frame (faces of a box, cells of a grid): all parts of distance and
    # normal must come from one face or cell.
    edges = collider.shape.has_edges
    local, body = at_nodes(placed, position)
    (lx, ly, lz), (bx, by, bz) = compute_once(local) if edges else materialize(local), materialize(body)
    distance, local_normal = collider.shape.distance((lx, ly, lz))
    # Cut before exp: deep inside it would overflow, and its derivative be 0 times infinity.
    influence = jnp.exp(-jnp.maximum(known_softness(collider) * distance, 0.0))
    # Once: each component of the velocity compares the influence with the least one that acts. It is faster too: XLA
    # would compute the whole chain, forward and backward, anew for every component.
    if edges:
        influence, local_normal = compute_once((influence, local_normal))
    else:
        influence, local_normal = stored(influence, local_normal)
    normal = cp.matvec(cp.split_matrix(placed.pose.rotation), local_normal)
    return Touch(distance, influence, normal, collider.friction, (bx, by, bz))


_touch_of_kind = jax.jit(touch)
"""Traced once for shapes of one kind. (The body's index is static: ``apply_colliders`` leaves it out.)"""

_LONG_RUN = 4
"""So many colliders of one kind are worth a loop."""


@pointwise
@jax.jit
def _velocity_after(moving: tuple[Collider, Placed], nodes: tuple[Vec3, Vec3]) -> Vec3:
    collider, placed = moving
    position, velocity = nodes
    return contact_velocity(touch(collider, position, placed), velocity)


_recomputed_velocity_after = recomputed(_velocity_after)


def _in_turn(colliders: Sequence[tuple[Collider, Placed]], position: Vec3, velocity: Vec3) -> Vec3:
    for collider, place_of_it in colliders:
        velocity = _velocity_after((collider, place_of_it), (position, velocity))
    return velocity


def _in_loops(colliders: Sequence[tuple[Collider, Placed]], position: Vec3, velocity: Vec3) -> Vec3:
    """The same, long runs of one kind of shape in a loop: less to compile, and less to keep for the backward pass."""
    for where in runs([collider for collider, _ in colliders]):
        run = colliders[where]
        if len(run) < _LONG_RUN:
            velocity = _in_turn(run, position, velocity)
            continue
        velocity, _ = jax.lax.scan(
            lambda v, c: (_recomputed_velocity_after(c, (position, v)), None), velocity, stacked(run)
        )
    return velocity


def nearest(touches: list[Touch]) -> tuple[Touch, list[Array]]:
    """The touch of least distance at each node, and the share that each of the given ones has in it, (num_nodes,).

    Several that are equally near (boxes side by side) share the node: the result is their mean, whatever their order.
    """
    # Once: computed anew where they are compared, equal distances could differ by rounding, and no collider be nearest.
    distances = compute_once([t.distance for t in touches])
    least = functools.reduce(jnp.minimum, distances)
    equal = [d == least for d in distances]
    one = 1.0 / sum(e.astype(least.dtype) for e in equal)
    shares = materialize([jnp.where(e, one, 0.0) for e in equal])
    # Once: its influence is compared as that of a single touch.
    return compute_once(
        jax.tree.map(lambda *leaves: sum(s * leaf for s, leaf in zip(shares, leaves, strict=True)), *touches)
    ), shares


def contact_velocity(touch: Touch, velocity: Vec3) -> Vec3:
    """Node velocities after contact: the law of ``apply_collider``. Gradient: exact."""
    influence, body = touch.influence, touch.velocity
    normal, relative = materialize((touch.normal, cp.subtract(velocity, body)))
    approach = materialize(jnp.minimum(cp.dot(relative, normal), 0.0))
    tangential = cp.vector(lambda i: relative[i] - approach * normal[i])
    slipping = materialize(friction_factor(tangential, approach, touch.friction))
    active = influence > MIN_INFLUENCE

    def after_contact(i: int) -> Array:
        u, u_t = relative[i], tangential[i] * slipping
        return jnp.where(active, body[i] + (1.0 - influence) * u + influence * u_t, velocity[i])

    return cp.vector(after_contact)


def check_bodies(colliders: tuple[Collider, ...], num_bodies: int) -> None:
    """Raises ValueError if a collider belongs to a body that has no pose (an index would be clamped in silence)."""
    for i, collider in enumerate(colliders):
        if not 0 <= collider.body < num_bodies:
            raise ValueError(
                f"collider {i} belongs to body {collider.body}, but there are poses of {num_bodies} bodies: give "
                "poses to all bodies, or the collider another body (they count from 0)"
            )


def shape_pose(collider: Collider, body: Pose) -> Pose:
    """Pose of a collider's shape, given that of its body. Gradient: exact."""
    return placed_at(Pose(collider.offset, collider.rotation), body)


def stacked(run: Sequence[T]) -> T:
    """Trees of one structure side by side, leading axis len(run); Python's numbers stay weakly typed."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *run)


def place(colliders: Sequence[Collider], before: Pose, after: Pose, dt: float) -> Placed:
    """Where shapes are in a substep, or in many, and how they move: for all at once, or programs of hands are long.

    Args:
      colliders: the shapes.
      before, after: poses of all bodies at the beginning and end of each substep, (..., num_bodies, 3), (...,
        num_bodies, 3, 3).
      dt: duration of a substep [s].

    Returns:
      Leading axes (..., num_colliders).

    Gradient: exact.
    """
    mounts = Pose(_rows([c.offset for c in colliders], (3,)), _rows([c.rotation for c in colliders], (3, 3)))
    bodies = np.array([c.body for c in colliders], int)
    start, end = (
        placed_at(mounts, Pose(pose.position[..., bodies, :], pose.rotation[..., bodies, :, :]))
        for pose in (before, after)
    )
    return placed(start, chord_motion(start, end, dt))


def _rows(arrays: list[Array], shape: tuple[int, ...]) -> Array:
    # All numbers in a row first: XLA is slow at putting many small matrices side by side.
    return jnp.concatenate([jnp.zeros(0, jnp.result_type(*arrays, np.float32)), *map(jnp.ravel, arrays)]).reshape(
        -1, *shape
    )


def friction_factor(tangential: Vec3, approach: Array, friction: Scalar) -> Array:
    """What Coulomb friction leaves of the tangential velocity [-]: max(0, |u_t| + mu u_n) / |u_t|; 1 without contact.

    Args:
      tangential: u_t, components of shape (n,) [m/s].
      approach: u_n, velocity along the normal, negative towards the body [m/s], shape (n,).
      friction: Coulomb coefficient mu [-].

    Gradient: exact, zero-safe. Source: Stomakhin et al. 2013, "A material point method for snow simulation", section 8.
    """
    square = cp.dot(tangential, tangential)
    rubs = (approach < 0) & (square > 1e-30)
    length = jnp.sqrt(jnp.where(rubs, square, 1.0))
    return jnp.where(rubs, jnp.maximum(length + friction * approach, 0.0) / length, 1.0)
