"""Loops over the substeps of a control step, with a choice of what the backward pass stores."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax

from rewax.physics.numerics.checks import static_integer

T = TypeVar("T")


def scan_substeps(body: Callable[[T, Any], T], carry: T, intervals: Any, store_every: int | None) -> T:
    """``carry = body(carry, interval)`` for each substep.

    Args:
      body: one substep, ``recomputed`` unless ``store_every`` is None.
      carry: state that a substep hands to the next.
      intervals: pytree of arrays with a first axis of num_substeps: inputs of each substep.
      store_every: the backward pass stores the carry every ``store_every`` substeps, a divisor of num_substeps; None:
        it stores everything.

    Raises:
      ValueError: ``store_every`` is no integer that divides num_substeps.

    Gradient: exact.
    """
    num_substeps = jax.tree.leaves(intervals)[0].shape[0]
    if store_every is not None:
        check_store_every(store_every, num_substeps)

    def chunk(carry: T, intervals: Any) -> tuple[T, None]:
        return jax.lax.scan(lambda c, interval: (body(c, interval), None), carry, intervals)

    if store_every is None or store_every == 1:
        return chunk(carry, intervals)[0]
    chunks = jax.tree.map(lambda b: b.reshape(num_substeps // store_every, store_every, *b.shape[1:]), intervals)
    return jax.lax.scan(jax.checkpoint(chunk), carry, chunks)[0]


def check_store_every(store_every: Any, num_substeps: int) -> None:
    """Raises ValueError unless ``store_every`` is an integer that divides the number of substeps."""
    remedy = f"give an integer that divides the {num_substeps} substeps, or None"
    if num_substeps % static_integer("store_every", store_every, 1, remedy):
        raise ValueError(f"store_every is {store_every}: {remedy}")


def check_has_substeps(num_substeps: int) -> None:
    """Raises ValueError for a step without a substep, over which no force has a mean."""
    if num_substeps < 1:
        raise ValueError("poses has one boundary and so no substep: give poses at the boundaries of at least one")


def both_ends(boundaries: T) -> tuple[T, T]:
    """Values at the beginning and at the end of each substep, from values (num_substeps + 1, ...) at the boundaries."""
    return jax.tree.map(lambda b: b[:-1], boundaries), jax.tree.map(lambda b: b[1:], boundaries)
