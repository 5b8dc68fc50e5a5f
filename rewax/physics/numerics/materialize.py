"""A fusion boundary that XLA's CPU compiler respects."""

from typing import TypeVar

import jax
import jax.numpy as jnp

from rewax.physics.numerics.linear_pass import Arrays, linear_pass

T = TypeVar("T")


def materialize(tree: T) -> T:
    """The same arrays, computed once and stored, in the forward and in the backward pass.

    XLA fuses elementwise arithmetic into each of its consumers and recomputes it there; on a CPU a chain of such
    fusions can cost ten times the arithmetic. ``jax.lax.optimization_barrier`` should prevent that, but XLA's CPU
    pipeline drops it before it fuses. The operands of a while loop, though, must be stored: this is a loop that runs
    zero times, which the compiler cannot know. On other platforms it is an optimization barrier.

    Gradient: exact (the identity), forward and reverse.
    """
    leaves, treedef = jax.tree.flatten(tree)
    return jax.tree.unflatten(treedef, linear_pass(_store, _store, None, (), leaves))


def _store(static: None, residuals: Arrays, linear: Arrays) -> Arrays:
    del static, residuals
    return jax.lax.platform_dependent(*linear, cpu=_store_on_cpu, default=lambda *a: jax.lax.optimization_barrier(a))


def _store_on_cpu(*arrays):
    first = jax.lax.slice(arrays[0].reshape(-1), (0,), (1,))[0]
    never = first.astype(jnp.float32) < -jnp.inf  # not even for NaN
    more, out = jax.lax.while_loop(
        lambda carry: carry[0],
        lambda carry: (jnp.zeros_like(carry[0]), tuple(a + a for a in carry[1])),
        (never, arrays),
    )
    del more
    return out
