"""Data of a rollout in parts."""

import jax

from rewax.types import Key, PyTree


def shuffled(key: Key, batch: PyTree, num_parts: int) -> PyTree:
    """Samples in a new order, in equal parts.

    Args:
      key: draws the order.
      batch: leaves with two leading axes (num_envs, T).
      num_parts: a divisor of num_envs * T.

    Returns:
      Leaves with leading axes (num_parts, num_envs * T / num_parts).
    """
    flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), batch)
    order = jax.random.permutation(key, len(jax.tree.leaves(flat)[0]))
    return jax.tree.map(lambda a: a[order].reshape(num_parts, -1, *a.shape[1:]), flat)
