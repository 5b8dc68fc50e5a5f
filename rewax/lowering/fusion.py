"""A fusion boundary that XLA's CPU compiler respects, under two names: one for speed, one for correctness.

XLA fuses elementwise arithmetic into each of its consumers and recomputes it there. On a CPU a chain of such fusions
can cost ten times the arithmetic, and each of them may round otherwise (a product and a sum become one operation here
and two there). ``jax.lax.optimization_barrier`` should prevent that, but XLA's CPU pipeline drops it before it fuses.
The operands of a while loop, though, must be stored: the boundary is a loop that runs zero times, which the compiler
cannot know. On other platforms a boundary for speed is nothing at all, for there what is stored between two kernels
costs more than what is computed twice; one for correctness is an optimization barrier.
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from rewax.lowering.linear_primitive import Arrays, ByPlatform, linear_call

T = TypeVar("T")
S = TypeVar("S")


def materialize(tree: T) -> T:
    """The same arrays, on a CPU stored before their users, in the value and in the derivatives: for speed.

    A program without it gives the same numbers, up to rounding. Where that is not so, write ``compute_once``.

    Gradient: exact (the identity), forward and reverse.
    """
    return _stored(tree, _FOR_SPEED)


def compute_once(tree: T) -> T:
    """The same arrays, of which all users see one and the same rounding: for correctness.

    It belongs wherever several users take a decision by these numbers (rounding down, a comparison, an equality) and
    must take the same one. A program without it may be wrong by far more than rounding.

    Gradient: exact (the identity), forward and reverse.
    """
    return _stored(tree, _FOR_CORRECTNESS)


def stored(once: T, fast: S) -> tuple[T, S]:
    """``(compute_once(once), materialize(fast))``, together: one loop on a CPU. Gradient: exact."""
    return _stored((once, fast), _FOR_BOTH, len(jax.tree.leaves(once)))


def _stored(tree: T, store: ByPlatform, num_once: int | None = None) -> T:
    leaves, treedef = jax.tree.flatten(tree)
    shapes = [jax.typeof(a) for a in leaves]
    return jax.tree.unflatten(treedef, linear_call(store, store, num_once, (), leaves, like=shapes))


def _store_on_cpu(static: int | None, residuals: Arrays, arrays: Arrays) -> Arrays:
    del static, residuals
    first = jax.lax.slice(arrays[0].reshape(-1), (0,), (1,))[0]
    never = first.astype(jnp.float32) < -jnp.inf  # not even for NaN
    more, out = jax.lax.while_loop(
        lambda carry: carry[0],
        lambda carry: (jnp.zeros_like(carry[0]), _otherwise(carry[1])),
        (never, arrays),
    )
    del more
    return out


def _otherwise(arrays: Arrays) -> Arrays:
    """Not the identity, or the compiler would remove the loop."""
    # Rotate arrays of equal shape: not provably an identity, and free. A sum each would be a third of all kernels.
    places: dict[Any, list[int]] = {}
    for i, a in enumerate(arrays):
        places.setdefault((a.shape, a.dtype), []).append(i)
    out = list(arrays)
    for where in places.values():
        for i, k in zip(where, [*where[1:], where[0]], strict=True):
            out[i] = arrays[k] if i != k else arrays[i] + arrays[i]
    return tuple(out)


def _hand_on(static: None, residuals: Arrays, arrays: Arrays) -> Arrays:
    del static, residuals
    return arrays


def _barrier(static: None, residuals: Arrays, arrays: Arrays) -> Arrays:
    del static, residuals
    return jax.lax.optimization_barrier(arrays)


def _barrier_of_first(num_once: int, residuals: Arrays, arrays: Arrays) -> Arrays:
    del residuals
    return (*jax.lax.optimization_barrier(arrays[:num_once]), *arrays[num_once:])


_FOR_SPEED = ByPlatform(cpu=_store_on_cpu, other=_hand_on)
_FOR_CORRECTNESS = ByPlatform(cpu=_store_on_cpu, other=_barrier)
_FOR_BOTH = ByPlatform(cpu=_store_on_cpu, other=_barrier_of_first)
