"""Broad phase: select the few colliders that can touch anything. Most of a hand's twenty capsules cannot.

Skipping a collider by a condition saves nothing under ``vmap``, where both branches run. So each run of colliders of
one kind evaluates a fixed number of them, the nearest ones. The omitted colliders change no node while at most that
number are near; ``count_excess`` checks this. (Exception: under ``Overlap.NEAREST`` a stiff collider that is too far to
act can be nearer to a node than a softer one that acts. Omitting the stiff one then changes the result.)
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
      colliders: all colliders. Neighbours in the tuple with one kind of shape form a run; a run of at most ``max_near``
        is kept unchanged.
      placed: their placements in a substep, leading axis num_colliders; see ``colliders.place``.
      lower, upper: corners of a box around everything that can be touched [m], shape (3,). Gradient: none.
      max_near: number of colliders kept of each run.

    Gradient: exact with respect to the kept colliders and placements.
    """
    kept = []
    for where in runs(colliders):
        run, of_run = colliders[where], _take(placed, where)
        if len(run) <= max_near:
            kept += [(c, _take(of_run, k)) for k, c in enumerate(run)]
            continue
        _, chosen = jax.lax.top_k(-_gaps(run, of_run.pose.position, lower, upper), max_near)
        chosen = jnp.sort(chosen)
        # The static body index is part of the structure; one common index lets colliders of several bodies stack.
        bodiless = stacked([c.replace(body=0) for c in run])
        moving = _take((bodiless, of_run), chosen)
        kept += [_take(moving, k) for k in range(max_near)]
    return kept


def count_excess(colliders: tuple[Collider, ...], poses: Pose, lower: Array, upper: Array, max_near: int) -> Array:
    """Largest number of near colliders in a run over time, minus ``max_near``; 0 or less: none was left out.

    Args:
      colliders, lower, upper, max_near: as for ``near_colliders``.
      poses: poses of all bodies at some times, (num_times, num_bodies, ...).

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
    """Distance of each collider of a run from the box, minus its reach [m], shape (len(run),); negative: it may act.

    ``centers`` are the origins of the shapes [m], shape (len(run), 3).
    """
    away = jnp.maximum(jnp.maximum(lower - centers, centers - upper), 0.0)
    reach = jnp.stack(
        [jnp.asarray(c.shape.bounding_radius() - math.log(MIN_INFLUENCE) / known_softness(c)) for c in run]
    )
    return jax.lax.stop_gradient(jnp.sqrt(jnp.sum(away * away, axis=-1)) - reach)
