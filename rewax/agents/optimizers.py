"""Optimizers that the algorithms share."""

import jax.numpy as jnp
import optax

from rewax.types import PyTree


def clipped_adamw(
    learning_rate: optax.ScalarOrSchedule, *, max_grad_norm: float, b1: float, b2: float, weight_decay: float
) -> optax.GradientTransformation:
    """AdamW on a gradient whose global norm is clipped.

    Args:
      learning_rate: a number, or a function of the number of updates.
      max_grad_norm: over everything that is updated.
      b1, b2: decay of the first and second moment.
      weight_decay: times the learning rate.
    """
    return optax.chain(
        optax.clip_by_global_norm(max_grad_norm),
        optax.scale_by_adam(b1, b2),
        optax.add_decayed_weights(weight_decay),
        optax.scale_by_learning_rate(learning_rate),
    )


def linear_fall(start: float, end: float, num_iterations: int, *, updates_per_iteration: int = 1) -> optax.Schedule:
    """A learning rate that falls linearly over the iterations of a run, constant within each, and stays at ``end``."""
    schedule = optax.linear_schedule(start, end, num_iterations)
    return lambda count: schedule(jnp.asarray(count) // updates_per_iteration)


def apply(
    optimizer: optax.GradientTransformation, grad: PyTree, opt_state: PyTree, params: PyTree
) -> tuple[PyTree, PyTree]:
    """Parameters and optimizer state after one update."""
    updates, opt_state = optimizer.update(grad, opt_state, params)
    return optax.apply_updates(params, updates), opt_state
