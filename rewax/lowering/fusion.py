"""A fusion boundary that XLA's CPU compiler respects, under two names: one for speed, one for correctness.

XLA fuses elementwise arithmetic into each of its consumers and recomputes it there. On a CPU a chain of such fusions
can cost ten times the arithmetic. Each fusion may round differently, because a product and a sum may become one
operation. ``jax.lax.optimization_barrier`` should prevent fusion, but XLA's CPU pipeline drops it before it fuses. XLA
must store the operands of a while loop, so the boundary is a loop that runs zero times, which the compiler cannot
prove. On other platforms a boundary for speed is the identity, because stores between kernels cost more than
recomputation; a boundary for correctness is an optimization barrier.
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from rewax.lowering.linear_primitive import Arrays, ByPlatform, linear_call

T = TypeVar("T")
S = TypeVar("S")


def materialize(tree: T) -> T:
    """The same arrays, stored before their consumers on a CPU, in the value and the derivatives: for speed.

    A program without it gives the same results up to rounding. If it would not, use ``compute_once``.

    Gradient: exact (the identity), forward and reverse.
    """
    return _stored(tree, _FOR_SPEED)


def compute_once(tree: T) -> T:
    """The same arrays, with the same rounding for all consumers: for correctness.

    Use it if several consumers take a decision on these values (floor, a comparison, an equality) and must agree. A
    program without it may be wrong by far more than rounding.

    Gradient: exact (the identity), forward and reverse.
    """
    return _stored(tree, _FOR_CORRECTNESS)


def stored(once: T, fast: S) -> tuple[T, S]:
    """``(compute_once(once), materialize(fast))`` in one loop on a CPU. Gradient: exact."""
    return _stored((once, fast), _FOR_BOTH, len(jax.tree.leaves(once)))


def _stored(tree: T, store: ByPlatform, num_once: int | None = None) -> T:
    leaves, treedef = jax.tree.flatten(tree)
    shapes = [jax.typeof(a) for a in leaves]
    return jax.tree.unflatten(treedef, linear_call(store, store, num_once, (), leaves, like=shapes))


def _store_on_cpu(static: int | None, residuals: Arrays, arrays: Arrays) -> Arrays:
    del static, residuals
    stored = [k for k, a in enumerate(arrays) if a.dtype != jax.dtypes.float0]  # derivatives of integers
    inside = tuple(arrays[k] for k in stored)
    some = next((a for a in inside if a.size), None)
    if some is None:
        return arrays
    first = jax.lax.slice(some.reshape(-1), (0,), (1,))[0]
    never = first.astype(jnp.float32) < -jnp.inf  # not even for NaN
    more, out = jax.lax.while_loop(
        lambda carry: carry[0],
        lambda carry: (jnp.zeros_like(carry[0]), _otherwise(carry[1])),
        (never, inside),
    )
    del more
    found = dict(zip(stored, out, strict=True))
    return tuple(found.get(k, a) for k, a in enumerate(arrays))


def _otherwise(arrays: Arrays) -> Arrays:
    """Not the identity, or the compiler would remove the loop."""
    # Rotate arrays of equal shape: not provably an identity, and free. A sum per array would be a third of all kernels.
    groups: dict[Any, list[int]] = {}
    for i, a in enumerate(arrays):
        groups.setdefault((a.shape, a.dtype), []).append(i)
    out = list(arrays)
    for group in groups.values():
        for i, k in zip(group, [*group[1:], group[0]], strict=True):
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
