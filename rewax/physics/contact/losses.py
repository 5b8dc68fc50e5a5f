"""Velocities that nodes lose to each of several colliders: what ``apply_colliders`` does, collider by collider."""

from collections.abc import Sequence

import jax

from rewax.physics.contact.colliders import (
    LONG_RUN,
    Collider,
    Overlap,
    contact_velocity,
    nearest,
    recomputed_velocity_after,
    runs,
    stacked,
    touch,
    velocity_after,
)
from rewax.physics.contact.motion import Placed
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3


def velocity_losses(
    colliders: Sequence[tuple[Collider, Placed]],
    position: Vec3,
    velocity: Vec3,
    *,
    overlap: Overlap = Overlap.SEQUENTIAL,
) -> tuple[Vec3, list[Vec3]]:
    """Node velocities after contact, and how much of its velocity each node loses to each collider [m/s].

    Args:
      colliders, position, velocity, overlap: as for ``colliders.apply_colliders``.

    Returns:
      The velocities of ``apply_colliders``, and for each collider the velocities before it minus those after it.
      Colliders that share a node under ``NEAREST`` share its loss.

    Gradient: as for ``apply_colliders``.
    """
    colliders = [(collider.replace(body=0), placed) for collider, placed in colliders]
    if not colliders:
        return velocity, []
    if overlap is Overlap.NEAREST and len(colliders) > 1:
        best, shares = nearest([touch(collider, position, placed) for collider, placed in colliders])
        after = contact_velocity(best, velocity)
        lost = cp.subtract(velocity, after)
        return after, [cp.scale(share, lost) for share in shares]
    if len(colliders) < LONG_RUN:
        each = _in_turn(colliders, position, velocity)
    else:
        each = jax.lax.platform_dependent(colliders, position, velocity, cpu=_in_loops, default=_in_turn)
    return each[-1], [cp.subtract(a, b) for a, b in zip([velocity, *each[:-1]], each, strict=True)]


def _in_turn(colliders: Sequence[tuple[Collider, Placed]], position: Vec3, velocity: Vec3) -> list[Vec3]:
    """Velocities after each collider."""
    found = []
    for moving in colliders:
        velocity = velocity_after(moving, (position, velocity))
        found.append(velocity)
    return found


def _in_loops(colliders: Sequence[tuple[Collider, Placed]], position: Vec3, velocity: Vec3) -> list[Vec3]:
    """``_in_turn`` with loops over long runs, as in ``colliders``."""
    found: list[Vec3] = []
    for where in runs([collider for collider, _ in colliders]):
        run, before = colliders[where], found[-1] if found else velocity
        if len(run) < LONG_RUN:
            found += _in_turn(run, position, before)
            continue

        def one(velocity: Vec3, moving: tuple[Collider, Placed]) -> tuple[Vec3, Vec3]:
            after = recomputed_velocity_after(moving, (position, velocity))
            return after, after

        _, each = jax.lax.scan(one, before, stacked(run))
        found += [cp.vector(lambda i, k=k, each=each: each[i][k]) for k in range(len(run))]
    return found


__all__ = ["velocity_losses"]
