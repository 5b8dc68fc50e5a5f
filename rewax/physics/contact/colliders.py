"""Moving rigid shapes as conditions on the velocities of grid nodes."""

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
from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, POSITIVE, static_integer
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.fields import checked, instance, integer, items, static
from rewax.physics.numerics.pose import Pose, placed_at
from rewax.physics.shapes.base import Shape
from rewax.physics.shapes.solid import distance_to
from rewax.types import Array, Scalar, Vector

T = TypeVar("T")

MIN_INFLUENCE = 0.1
"""A collider acts where its influence exceeds this: within log(10) / softness of its surface."""
REACH_IN_CELLS = 1.0
"""Reach of a collider whose softness is None [cells of the grid]."""


@struct.dataclass
class Collider(struct.Replaceable):
    """A rigid shape fixed to a body. The body's motion is prescribed (``mpm``) or follows from forces (``coupling``).

    Attributes:
      shape: its signed distance, in its own frame.
      offset: origin of the shape's frame in the body's frame [m], shape (3,); by default zero.
      rotation: rotation from the shape's frame to the body's, shape (3, 3); by default the identity.
      friction: Coulomb coefficient [-], >= 0.
      softness: decay of the influence with distance [1/m], > 0; influence = min(exp(-softness * distance), 1). None:
        log(10) / spacing, a reach of one cell, see ``with_softness``. Rewarped uses 666. Tetrahedra ignore it.
      body: index of the body that carries it (static).
    """

    shape: Shape
    offset: Vector = struct.number(
        FINITE, "give a position in metres", shape=(3,), default_factory=lambda: jnp.zeros(3)
    )
    rotation: Vector = struct.number(FINITE, "give a rotation matrix", shape=(3, 3), default_factory=lambda: jnp.eye(3))
    friction: Scalar = struct.number(NOT_NEGATIVE, "give a Coulomb coefficient, 0 for none", shape=())
    softness: Scalar | None = struct.number(
        POSITIVE, "give a decay per metre, or None for a reach of one cell", shape=(), default=None
    )
    body: int = struct.static_field(default=0)

    def __post_init__(self) -> None:
        static_integer("Collider.body", self.body, 0, "give the index of a body, counted from 0")


COLLIDER = instance(Collider, "give a Collider(shape=..., friction=...)")
COLLIDERS = items(COLLIDER, "give a tuple of colliders, () for none")
"""Rules for colliders."""


class Overlap(enum.Enum):
    """How several colliders act on one node."""

    SEQUENTIAL = "sequential"
    """One after the other, in the order of the scene: where they overlap, the last one wins. Rewarped's law."""
    NEAREST = "nearest"
    """Only the collider with the nearest surface acts (inside several: the one in which the node lies deepest). So
    colliders act like the union of their shapes, in any order. With many shapes it is faster: the law is evaluated once
    per node."""


class Touch(NamedTuple):
    """Values of a collider at nodes, arrays of shape (num_nodes,)."""

    distance: Array
    """Signed distance [m]."""
    influence: Array
    """Weight of the collider's velocity at the node, min(exp(-softness distance), 1) [-]."""
    normal: Vec3
    """Unit vector pointing away from the collider, in the world's frame."""
    friction: Scalar
    """Coulomb coefficient [-], shape () or (num_nodes,)."""
    velocity: Vec3
    """Velocity of the body's material point at the node [m/s]."""


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
      position: node positions [m], components of shape (num_nodes,). Gradient: none.
      velocity: node velocities [m/s], components of shape (num_nodes,).
      overlap: how they act together (static).

    Returns:
      Node velocities [m/s], components of shape (num_nodes,).

    Raises:
      ValueError: a softness is None, see ``with_softness``.

    Gradient: as for ``apply_collider``. With ``NEAREST`` two equally near colliders contribute the mean.
    """
    colliders = [(collider.replace(body=0), placed) for collider, placed in colliders]
    if overlap is Overlap.SEQUENTIAL or len(colliders) < 2:
        if len(colliders) < LONG_RUN:
            return _in_turn(colliders, position, velocity)
        # XLA on a CPU compiles a kernel for each step of each collider; on a GPU one kernel holds many colliders.
        return jax.lax.platform_dependent(colliders, position, velocity, cpu=_in_loops, default=_in_turn)
    touches = [_touch_of_kind(collider, position, placed) for collider, placed in colliders]
    return contact_velocity(nearest(touches)[0], velocity)


def runs(colliders: Sequence[Collider]) -> list[slice]:
    """Slices of neighbours that can be stacked: one kind of shape, equal parameter shapes, any body."""

    def kind(collider: Collider) -> Any:
        leaves, treedef = jax.tree.flatten(collider.replace(body=0))
        return struct.Structure.of(treedef), tuple(jnp.shape(leaf) for leaf in leaves)

    ends = list(itertools.accumulate(len(list(run)) for _, run in itertools.groupby(colliders, kind)))
    return [slice(*ends) for ends in itertools.pairwise([0, *ends])]


@checked(colliders=COLLIDERS, spacing=static(POSITIVE, "give the grid's spacing in metres"))
def with_softness(colliders: Sequence[Collider], spacing: float) -> tuple[Collider, ...]:
    """The colliders, with a reach of one cell where the softness is None.

    With a shorter reach nodes come into contact one after the other, at influences between 0.1 and 1. These are steps
    that no derivative sees (``benchmarks/particle_contact_gradients.py``).

    Args:
      colliders: colliders of a scene.
      spacing: spacing of its grid [m].

    Gradient: exact.
    """
    softness = -math.log(MIN_INFLUENCE) / (REACH_IN_CELLS * spacing)
    return tuple(c.replace(softness=softness) if c.softness is None else c for c in colliders)


def known_softness(collider: Collider) -> Scalar:
    """Softness of a collider [1/m].

    Raises:
      ValueError: it is None. This function has no grid to derive it from.
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
      position: node positions [m], components of shape (num_nodes,). Gradient: none.
      velocity: node velocities [m/s], components of shape (num_nodes,).
      before, after: pose of the collider's body at the beginning and end of the substep, shapes (3,), (3, 3).
      dt: duration of the substep [s].

    Returns:
      Node velocities [m/s], components of shape (num_nodes,).

    Raises:
      ValueError: the softness is None, see ``with_softness``.

    Gradient: exact with respect to velocities, poses, friction, softness and the shape's sizes; for u_n = 0 that of a
      node that leaves. The onset of contact at influence 0.1 is a step that no derivative sees.
    Source: Huang et al. 2021, PlasticineLab, appendix; the law used by Rewarped.
    """
    start, end = shape_pose(collider, before), shape_pose(collider, after)
    return apply_colliders([(collider, placed(start, chord_motion(start, end, dt)))], position, velocity)


def touch(collider: Collider, position: Vec3, placed: Placed) -> Touch:
    """Distance, normal, influence and velocity of a collider at nodes.

    Args:
      collider: the shape.
      position: node positions [m], components of shape (num_nodes,). Gradient: none.
      placed: its placement, without leading axes.

    Gradient: exact.
    """
    # Shapes with edges compare coordinates (faces of a box, cells of a grid). Computed once, so that distance and
    # normal come from one face or cell: fused copies may round differently.
    edges = collider.shape.has_edges
    local, body = at_nodes(placed, position)
    (lx, ly, lz), (bx, by, bz) = compute_once(local) if edges else materialize(local), materialize(body)
    distance, local_normal = distance_to(collider.shape, (lx, ly, lz))
    # Clipped before exp: deep inside exp would overflow, and its derivative would be 0 times infinity.
    influence = jnp.exp(-jnp.maximum(known_softness(collider) * distance, 0.0))
    # Computed once: each velocity component compares the influence with ``MIN_INFLUENCE``, and all must agree. It is
    # faster, too: XLA would recompute the chain, forward and backward, for every component.
    if edges:
        influence, local_normal = compute_once((influence, local_normal))
    else:
        influence, local_normal = stored(influence, local_normal)
    normal = cp.matvec(cp.split_matrix(placed.pose.rotation), local_normal)
    return Touch(distance, influence, normal, collider.friction, (bx, by, bz))


_touch_of_kind = jax.jit(touch)
"""``jit`` traces it once per kind of shape. (``apply_colliders`` sets the static body index to 0.)"""

LONG_RUN = 4
"""Shortest run of one kind that is evaluated in a loop."""


@pointwise
@jax.jit
def velocity_after(moving: tuple[Collider, Placed], nodes: tuple[Vec3, Vec3]) -> Vec3:
    collider, placed = moving
    position, velocity = nodes
    return contact_velocity(touch(collider, position, placed), velocity)


recomputed_velocity_after = recomputed(velocity_after)


def _in_turn(colliders: Sequence[tuple[Collider, Placed]], position: Vec3, velocity: Vec3) -> Vec3:
    for moving in colliders:
        velocity = velocity_after(moving, (position, velocity))
    return velocity


def _in_loops(colliders: Sequence[tuple[Collider, Placed]], position: Vec3, velocity: Vec3) -> Vec3:
    """``_in_turn`` with loops over long runs: less code to compile, less memory for the backward pass."""
    for where in runs([collider for collider, _ in colliders]):
        run = colliders[where]
        if len(run) < LONG_RUN:
            velocity = _in_turn(run, position, velocity)
            continue
        velocity, _ = jax.lax.scan(
            lambda v, c: (recomputed_velocity_after(c, (position, v)), None), velocity, stacked(run)
        )
    return velocity


def nearest(touches: list[Touch]) -> tuple[Touch, list[Array]]:
    """The touch of least distance at each node, and the share of each given touch in it, (num_nodes,).

    Equally near colliders (boxes side by side) share a node: the result is their mean, in any order.
    """
    # Computed once: fused copies may round differently, and then no distance would equal the least.
    distances = compute_once([t.distance for t in touches])
    least = functools.reduce(jnp.minimum, distances)
    equal = [d == least for d in distances]
    one = 1.0 / sum(e.astype(least.dtype) for e in equal)
    shares = materialize([jnp.where(e, one, 0.0) for e in equal])
    # Computed once, as in ``touch``: the influence is compared.
    return compute_once(
        jax.tree.map(lambda *leaves: sum(s * leaf for s, leaf in zip(shares, leaves, strict=True)), *touches)
    ), shares


def contact_velocity(touch: Touch, velocity: Vec3) -> Vec3:
    """Node velocities after contact: the law of ``apply_collider``. Gradient: exact."""
    influence, body = touch.influence, touch.velocity
    normal, relative = materialize((touch.normal, cp.subtract(velocity, body)))
    separating = cp.dot(relative, normal)
    # At 0 ``minimum`` has half of the derivative, and contacts one after the other multiply these halves.
    approach = materialize(jnp.where(separating < 0, separating, 0.0))
    tangential = cp.vector(lambda i: relative[i] - approach * normal[i])
    slipping = materialize(friction_factor(tangential, approach, touch.friction))
    active = influence > MIN_INFLUENCE

    def after_contact(i: int) -> Array:
        u, u_t = relative[i], tangential[i] * slipping
        return jnp.where(active, body[i] + (1.0 - influence) * u + influence * u_t, velocity[i])

    return cp.vector(after_contact)


@checked(colliders=COLLIDERS, num_bodies=integer(0, "give the number of bodies"))
def check_bodies(colliders: Sequence[Collider], num_bodies: int) -> None:
    """Raises ValueError if a collider's body has no pose (JAX would clamp the index silently)."""
    for i, collider in enumerate(colliders):
        if not 0 <= collider.body < num_bodies:
            raise ValueError(
                f"collider {i} belongs to body {collider.body}, but there are poses of {num_bodies} bodies: give "
                "poses to all bodies, or the collider another body (they count from 0)"
            )


def shape_pose(collider: Collider, body: Pose) -> Pose:
    """Pose of a collider's shape in the world, shapes (3,) and (3, 3), given its body's pose. Gradient: exact."""
    return placed_at(Pose(collider.offset, collider.rotation), body)


def stacked(run: Sequence[T]) -> T:
    """Trees of one structure stacked, leading axis len(run). Python numbers stay weakly typed."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *run)


def place(colliders: Sequence[Collider], before: Pose, after: Pose, dt: float) -> Placed:
    """Placements and motions of all shapes in one or many substeps.

    They are computed in one batch: a hand has twenty colliders, and its program would be long.

    Args:
      colliders: the shapes.
      before, after: poses of all bodies at the beginning and end of each substep, (..., num_bodies, 3), (...,
        num_bodies, 3, 3).
      dt: duration of a substep [s].

    Returns:
      Placements with leading axes (..., num_colliders).

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
    # Flattened first: XLA is slow at concatenating many small matrices.
    return jnp.concatenate([jnp.zeros(0, jnp.result_type(*arrays, np.float32)), *map(jnp.ravel, arrays)]).reshape(
        -1, *shape
    )


def friction_factor(tangential: Vec3, approach: Array, friction: Scalar) -> Array:
    """Share of the tangential velocity after Coulomb friction [-]: max(0, |u_t| + mu u_n) / |u_t|; 1 without contact.

    Args:
      tangential: u_t [m/s], components of shape (n,).
      approach: u_n, velocity along the normal [m/s], negative towards the body, shape (n,).
      friction: Coulomb coefficient mu [-].

    Gradient: exact, also where u_t is zero: friction then holds, and the share is 0.
    Source: Stomakhin et al. 2013, "A material point method for snow simulation", section 8.
    """
    square = cp.dot(tangential, tangential)
    rubs = (approach < 0) & (square > 1e-30)
    length = jnp.sqrt(jnp.where(rubs, square, 1.0))
    held = friction * approach < 0  # without rubbing u_t is zero, and so is it after a small change of it
    return jnp.where(rubs, jnp.maximum(length + friction * approach, 0.0) / length, jnp.where(held, 0.0, 1.0))
