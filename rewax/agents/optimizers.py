"""Optimizers of all algorithms: AdamW with a clipped gradient, on parameters packed into one vector."""

from typing import TypeGuard

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from rewax import struct
from rewax.lowering.fusion import materialize
from rewax.lowering.splitting import split_vector
from rewax.types import Array, PyTree


def clipped_adamw(
    learning_rate: optax.ScalarOrSchedule, *, max_grad_norm: float, b1: float, b2: float, weight_decay: float
) -> optax.GradientTransformation:
    """AdamW on a gradient whose global norm is clipped.

    Args:
      learning_rate: a number, or a function of the number of updates.
      max_grad_norm: limit of the norm over all parameters.
      b1, b2: decay of the first and second moment.
      weight_decay: decoupled weight decay, multiplied by the learning rate.
    """
    return optax.chain(
        optax.clip_by_global_norm(max_grad_norm),
        optax.scale_by_adam(b1, b2),
        optax.add_decayed_weights(weight_decay),
        optax.scale_by_learning_rate(learning_rate),
    )


def linear_fall(start: float, end: float, num_iterations: int, *, updates_per_iteration: int = 1) -> optax.Schedule:
    """A learning rate that falls linearly over ``num_iterations`` and then stays at ``end``.

    It is constant within an iteration of ``updates_per_iteration`` updates, and everywhere if ``end`` is above
    ``start``.
    """
    schedule = optax.linear_schedule(start, min(start, end), num_iterations)
    return lambda count: schedule(jnp.asarray(count) // updates_per_iteration)


def schedule_at(opt_state: PyTree, count: Array) -> PyTree:
    """The optimizer's state with the learning rate that it has after ``count`` updates. All else stays."""

    def is_schedule(part: object) -> bool:
        return isinstance(part, optax.ScaleByScheduleState)

    def moved(part: PyTree) -> PyTree:
        return part._replace(count=count.astype(part.count.dtype)) if is_schedule(part) else part

    return jax.tree.map(moved, opt_state, is_leaf=is_schedule)


@struct.dataclass
class Packed:
    """Parameters, or another tree of the same structure and shapes, as one vector, shape (number of parameters,)."""

    vector: Array


class Packing:
    """Packs parameters into one vector, so that an optimizer needs a few kernels in all instead of a few per layer.

    A single array, or arrays of several dtypes, are not packed.
    """

    def __init__(self, params: PyTree) -> None:
        leaves, self._treedef = jax.tree.flatten(params)
        self._shapes = [jnp.shape(leaf) for leaf in leaves]
        self._pays = len(leaves) > 1 and _have_one_type(leaves)

    def pack(self, tree: PyTree) -> PyTree:
        """The tree with ``Packed`` in place of each subtree that has the parameters' structure and shapes."""
        return jax.tree.map(lambda part: self._packed(part) if self._fits(part) else part, tree, is_leaf=self._fits)

    def unpack(self, tree: PyTree) -> PyTree:
        """The inverse of ``pack``."""
        parts, treedef = jax.tree.flatten(tree, is_leaf=_is_packed)
        indices = [i for i, part in enumerate(parts) if _is_packed(part)]
        if indices:  # materialised, because otherwise XLA computes each part of a vector in a separate kernel
            for i, packed in zip(indices, materialize([parts[i] for i in indices]), strict=True):
                parts[i] = self._parts(packed)
        return jax.tree.unflatten(treedef, parts)

    def _fits(self, part: PyTree) -> bool:
        if not self._pays or jax.tree.structure(part) != self._treedef:
            return False
        leaves = jax.tree.leaves(part)
        return [jnp.shape(leaf) for leaf in leaves] == self._shapes and _have_one_type(leaves)

    def _packed(self, part: PyTree) -> Packed:
        return Packed(vector=ravel_pytree(part)[0])

    def _parts(self, packed: Packed) -> PyTree:
        return jax.tree.unflatten(self._treedef, split_vector(packed.vector, self._shapes))


def _have_one_type(leaves: list[Array]) -> bool:
    return len({jnp.result_type(leaf) for leaf in leaves}) == 1


def _is_packed(part: object) -> TypeGuard[Packed]:
    return isinstance(part, Packed)


def apply(
    optimizer: optax.GradientTransformation,
    grad: PyTree,
    opt_state: PyTree,
    params: PyTree,
    *,
    scale: Array | float = 1.0,
) -> tuple[PyTree, PyTree]:
    """One update, multiplied by ``scale``; returns parameters and optimizer state."""
    packing = Packing(params)
    grad, opt_state, params = packing.pack((grad, opt_state, params))
    updates, opt_state = optimizer.update(grad, opt_state, params)
    params = optax.apply_updates(params, optax.tree.scale(scale, updates))
    return packing.unpack((params, opt_state))


def finite_or_zero(grad: PyTree) -> PyTree:
    """The gradient, with non-finite components replaced by zero."""
    return jax.tree.map(lambda g: jnp.where(jnp.isfinite(g), g, 0.0), grad)
