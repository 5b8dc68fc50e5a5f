"""Loops over the substeps of a control step, and what their backward pass stores."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax

T = TypeVar("T")


def scan_substeps(body: Callable[[T, Any], T], carry: T, intervals: Any, store_every: int | None) -> T:
    """``carry = body(carry, interval)`` for each substep.

    Args:
      body: one substep, ``recomputed`` unless ``store_every`` is None.
      carry: what one substep passes to the next.
      intervals: pytree of arrays with a first axis of num_substeps: what is known of each beforehand.
      store_every: what the backward pass keeps: the carry every so many substeps, a number that divides theirs; None:
        everything.

    Gradient: exact.
    """
    num_substeps = jax.tree.leaves(intervals)[0].shape[0]
    if store_every is not None and (store_every < 1 or num_substeps % store_every):
        raise ValueError(
            f"store_every is {store_every} with {num_substeps} substeps: give a number that divides them, or None"
        )

    def chunk(carry: T, intervals: Any) -> tuple[T, None]:
        return jax.lax.scan(lambda c, interval: (body(c, interval), None), carry, intervals)

    if store_every is None or store_every == 1:
        return chunk(carry, intervals)[0]
    chunks = jax.tree.map(lambda b: b.reshape(num_substeps // store_every, store_every, *b.shape[1:]), intervals)
    return jax.lax.scan(jax.checkpoint(chunk), carry, chunks)[0]


def both_ends(boundaries: T) -> tuple[T, T]:
    """What holds at the beginning and at the end of each substep, given (num_substeps + 1, ...) boundaries between."""
    return jax.tree.map(lambda b: b[:-1], boundaries), jax.tree.map(lambda b: b[1:], boundaries)
