"""Of many colliders, the few that can touch anything: for hands, whose twenty capsules are mostly in the air.

Skipping a collider by a condition saves nothing under ``vmap``, where both branches run. So of each run of colliders of
one kind a fixed number is evaluated, the nearest ones. What is left out would not have changed a node, as long as no
more than that number are near; ``count_excess`` tells. (Under
``Overlap.NEAREST`` a stiff collider that is too far to act can be nearer to a node than a softer one that acts: there
leaving it out makes a difference.)
"""

import itertools
import math
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from rewax.physics.contact.colliders import MIN_INFLUENCE, Collider, known_softness, shape_pose
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.shapes.primitives import Box, Capsule, Cone, Cylinder, Ellipsoid, Shape, Sphere
from rewax.types import Array, Scalar

T = TypeVar("T")


def near_colliders(
    colliders: tuple[Collider, ...], before: Pose, after: Pose, lower: Array, upper: Array, max_near: int
) -> list[tuple[Collider, Pose, Pose]]:
    """The colliders to evaluate, in the order given, with the poses of their bodies at both ends of a substep.

    Args:
      colliders: all of them. Neighbours in the tuple that are of one kind of shape form a run; a run of at most
        ``max_near`` is kept as it is.
      before, after: poses of all bodies, (num_bodies, 3), (num_bodies, 3, 3).
      lower, upper: corners of a box that holds whatever can be touched [m], shape (3,). Gradient: none.
      max_near: how many of each run are kept.

    Gradient: exact with respect to colliders and poses that are kept.
    """
    kept = []
    for run in _runs(colliders):
        if len(run) <= max_near:
            kept += [(c, body_pose(before, c.body), body_pose(after, c.body)) for c in run]
            continue
        _, chosen = jax.lax.top_k(-_gaps(run, before, lower, upper), max_near)
        chosen = jnp.sort(chosen)
        # The body's index is static, part of the structure: without it colliders of several bodies can be stacked.
        stacked = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(a) for a in leaves]), *_bodiless(run))
        bodies = jnp.asarray([c.body for c in run])[chosen]
        moving = (_take(stacked, chosen), _take(before, bodies), _take(after, bodies))
        kept += [_take(moving, k) for k in range(max_near)]
    return kept


def count_excess(colliders: tuple[Collider, ...], poses: Pose, lower: Array, upper: Array, max_near: int) -> Array:
    """By how many more than ``max_near`` colliders of one run are near, at the worst time; 0 or less: all is well.

    Args:
      colliders, lower, upper, max_near: as for ``near_colliders``.
      poses: of all bodies at some times, (num_times, num_bodies, ...).

    Returns:
      Shape (), int32. Gradient: none.
    """

    def near(run: tuple[Collider, ...]) -> Array:
        gaps = jax.vmap(lambda p: _gaps(run, p, lower, upper))(poses)
        return jnp.max(jnp.sum(gaps < 0, axis=-1, dtype=jnp.int32))

    counts = [near(run) for run in _runs(colliders)]
    return jnp.max(jnp.stack(counts)) - max_near if counts else jnp.int32(-max_near)


def bounding_radius(shape: Shape) -> Scalar:
    """Radius of a ball around the shape's origin that holds it [m]; infinite for planes and whatever has no size.

    Gradient: exact.
    """
    match shape:
        case Sphere():
            return shape.radius
        case Capsule():
            return shape.radius + shape.half_length
        case Box():
            return jnp.sqrt(jnp.sum(jnp.asarray(shape.half_size) ** 2, axis=-1))
        case Cylinder() | Cone():
            return jnp.sqrt(jnp.asarray(shape.radius) ** 2 + jnp.asarray(shape.half_length) ** 2)
        case Ellipsoid():
            return jnp.max(jnp.asarray(shape.semi_axes), axis=-1)
    return jnp.inf


def _runs(colliders: tuple[Collider, ...]) -> list[tuple[Collider, ...]]:
    """Consecutive colliders that can be stacked: shapes of one kind with parameters of the same form."""

    def kind(collider: Collider) -> Any:
        leaves, treedef = jax.tree.flatten(_bodiless((collider,)))
        return type(collider.shape), treedef, tuple(jnp.shape(leaf) for leaf in leaves)

    return [tuple(run) for _, run in itertools.groupby(colliders, kind)]


def _bodiless(run: tuple[Collider, ...]) -> list[Collider]:
    return [c.replace(body=0) for c in run]


def _take(tree: T, index: Any) -> T:
    return jax.tree.map(lambda a: a[index], tree)


def _gaps(run: tuple[Collider, ...], poses: Pose, lower: Array, upper: Array) -> Array:
    """How far beyond their reach the colliders of a run are from the box [m], (len(run),); negative: they may act."""

    def gap(collider: Collider) -> Array:
        center = shape_pose(collider, body_pose(poses, collider.body)).position
        away = jnp.maximum(jnp.maximum(lower - center, center - upper), 0.0)
        reach = bounding_radius(collider.shape) - math.log(MIN_INFLUENCE) / known_softness(collider)
        return jnp.sqrt(jnp.sum(away * away)) - reach

    return jax.lax.stop_gradient(jnp.stack([gap(c) for c in run]))
