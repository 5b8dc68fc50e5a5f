"""A fusion boundary that XLA's CPU compiler respects, under two names: one for speed, one for correctness.

XLA fuses elementwise arithmetic into each of its consumers and recomputes it there. On a CPU a chain of such fusions
can cost ten times the arithmetic, and each copy may round otherwise (a product and a sum become one operation here and
two there). ``jax.lax.optimization_barrier`` should prevent that, but XLA's CPU pipeline drops it before it fuses. The
operands of a while loop, though, must be stored: the boundary is a loop that runs zero times, which the compiler cannot
know. On other platforms it is an optimization barrier.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp

from rewax.physics.numerics.linear_pass import Arrays, linear_pass

T = TypeVar("T")


def materialize(tree: T) -> T:
    """The same arrays, stored before their users, in the forward and in the backward pass: for speed.

    A program without it gives the same numbers, up to rounding. Where that is not so, write ``compute_once``.

    Gradient: exact (the identity), forward and reverse.
    """
    return _stored(tree)


def compute_once(tree: T) -> T:
    """The same arrays, of which all users see one and the same rounding: for correctness.

    It belongs wherever several users take a decision by these numbers (rounding down, a comparison, an equality) and
    must take the same one. A program without it may be wrong by far more than rounding.

    Gradient: exact (the identity), forward and reverse.
    """
    return _stored(tree)


def _stored(tree: T) -> T:
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
