"""Of many colliders, the few that can touch anything: for hands, whose twenty capsules are mostly in the air.

Skipping a collider by a condition saves nothing under ``vmap``, where both branches run. So of each run of colliders of
one kind a fixed number is evaluated, the nearest ones. What is left out would not have changed a node, as long as no
more than that number are near; ``count_excess`` tells. (Under
``Overlap.NEAREST`` a stiff collider that is too far to act can be nearer to a node than a softer one that acts: there
leaving it out makes a difference.)
"""

import math
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from rewax.physics.contact.colliders import MIN_INFLUENCE, Collider, known_softness, runs, shape_pose, stacked
from rewax.physics.contact.motion import Placed
from rewax.physics.numerics.pose import Pose
from rewax.types import Array

T = TypeVar("T")


def near_colliders(
    colliders: tuple[Collider, ...], placed: Placed, lower: Array, upper: Array, max_near: int
) -> list[tuple[Collider, Placed]]:
    """The colliders to evaluate, in the order given, with their placements.

    Args:
      colliders: all of them. Neighbours in the tuple that are of one kind of shape form a run; a run of at most
        ``max_near`` is kept as it is.
      placed: all of them, in a substep, leading axis num_colliders; see ``colliders.place``.
      lower, upper: corners of a box that holds whatever can be touched [m], shape (3,). Gradient: none.
      max_near: how many of each run are kept.

    Gradient: exact with respect to colliders and placements that are kept.
    """
    kept = []
    for where in runs(colliders):
        run, of_run = colliders[where], _take(placed, where)
        if len(run) <= max_near:
            kept += [(c, _take(of_run, k)) for k, c in enumerate(run)]
            continue
        _, chosen = jax.lax.top_k(-_gaps(run, of_run.pose.position, lower, upper), max_near)
        chosen = jnp.sort(chosen)
        # The body's index is static, part of the structure: without it colliders of several bodies can be stacked.
        bodiless = stacked([c.replace(body=0) for c in run])
        moving = _take((bodiless, of_run), chosen)
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
        centers = jnp.stack([shape_pose(c, Pose(*(a[:, c.body] for a in poses))).position for c in run], axis=1)
        gaps = jax.vmap(lambda centers: _gaps(run, centers, lower, upper))(centers)
        return jnp.max(jnp.sum(gaps < 0, axis=-1, dtype=jnp.int32))

    counts = [near(colliders[where]) for where in runs(colliders)]
    return jnp.max(jnp.stack(counts)) - max_near if counts else jnp.int32(-max_near)


def _take(tree: T, index: Any) -> T:
    return jax.tree.map(lambda a: a[index], tree)


def _gaps(run: tuple[Collider, ...], centers: Array, lower: Array, upper: Array) -> Array:
    """How far beyond their reach the colliders of a run, of the given origins (len(run), 3), are from the box [m],
    (len(run),); negative: they may act.
    """
    away = jnp.maximum(jnp.maximum(lower - centers, centers - upper), 0.0)
    reach = jnp.stack(
        [jnp.asarray(c.shape.bounding_radius() - math.log(MIN_INFLUENCE) / known_softness(c)) for c in run]
    )
    return jax.lax.stop_gradient(jnp.sqrt(jnp.sum(away * away, axis=-1)) - reach)
