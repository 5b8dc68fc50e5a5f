"""Gradients through rollouts: one per environment, so that a non-finite gradient of one leaves the others intact."""

from collections.abc import Callable
from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import optax

from rewax.agents.base import Metrics
from rewax.agents.devices import check_closes_over_no_array
from rewax.agents.optimizers import Packing
from rewax.agents.run_state import Environments, RunState
from rewax.envs.base import State
from rewax.envs.wrappers import AutoReset
from rewax.status import all_finite
from rewax.types import Array, Key, PyTree

R = TypeVar("R", bound=RunState)
D = TypeVar("D")

Loss: TypeAlias = Callable[[PyTree, R, AutoReset, State, Key], tuple[Array, D]]
"""``(params, common, env, env_state, key) -> (loss, data)`` of one environment; common: ``RunState.common()``."""


def per_env_gradients(
    loss: Loss[R, D], params: PyTree, common: R, environments: Environments, key: Key
) -> tuple[Array, D, PyTree]:
    """Loss, data and gradient of every environment.

    Args:
      loss: of one environment behind ``AutoReset``, from its state. A function of the module whose configuration is
        bound by ``functools.partial``; it has its arrays from its arguments.
      params: what the gradient is taken with respect to.
      common: what else all environments share, ``RunState.common()``.
      environments: ``num_envs`` of them.
      key: split into one key per environment.

    Returns:
      Losses, shape (num_envs,); data, no gradient flows out of it; gradients. All have a leading axis of environments.

    Raises:
      ValueError: the loss closes over an array.
    """
    check_closes_over_no_array(loss)
    value_and_grad = jax.value_and_grad(loss, has_aux=True)
    (losses, data), grads = environments.map(
        lambda shared, env, state, key: value_and_grad(*shared, env, state, key),
        (params, common),
        environments.split(key),
    )
    return losses, jax.lax.stop_gradient(data), grads


def mean_gradient(losses: Array, grads: PyTree, *, max_norm: float | None = None) -> tuple[PyTree, Metrics]:
    """The mean of the environments' finite gradients, and what to report of it.

    Args:
      losses, grads: as ``per_env_gradients`` returns them.
      max_norm: to which each environment's gradient is clipped first; None: not.

    Returns:
      The gradient, and the metrics ``actor_loss``, ``actor_grad_norm`` and ``dropped_gradients``.
    """
    packing = Packing(jax.eval_shape(lambda: jax.tree.map(lambda g: g[0], grads)))
    grads = jax.vmap(packing.pack)(grads)
    if max_norm is not None:
        grads = clip_per_env(grads, max_norm)
    grad, kept = mean_of_finite(losses, grads)
    return packing.unpack(grad), {
        "actor_loss": jnp.sum(jnp.where(kept, losses, 0.0)) / jnp.maximum(kept.sum(), 1),
        "actor_grad_norm": optax.tree.norm(grad),
        "dropped_gradients": jnp.sum(~kept),
    }


def mean_of_finite(losses: Array, grads: PyTree) -> tuple[PyTree, Array]:
    """Mean gradient over the environments whose loss and gradient are finite.

    Args:
      losses: shape (num_envs,).
      grads: leaves with a leading axis of environments.

    Returns:
      The mean, zero if no environment is left, and which environments were kept, shape (num_envs,), bool.
    """
    kept = jax.vmap(all_finite)((losses, grads))
    count = jnp.maximum(kept.sum(), 1)

    def mean(g: Array) -> Array:
        return jnp.sum(jnp.where(_expand(kept, g), g, 0.0), axis=0) / count

    return jax.tree.map(mean, grads), kept


def clip_per_env(grads: PyTree, max_norm: float) -> PyTree:
    """Each environment's gradient, shortened to a global norm of ``max_norm`` where it is longer.

    A gradient that is not finite, or whose norm is not, becomes NaN; ``mean_of_finite`` leaves it out.
    """
    norms = jax.vmap(optax.tree.norm)(grads)
    scale = jnp.minimum(1.0, max_norm / jnp.where(norms > 0, norms, 1.0))
    scale = jnp.where(jnp.isfinite(norms), scale, jnp.nan)
    return jax.tree.map(lambda g: g * _expand(scale, g), grads)


def _expand(per_env: Array, like: Array) -> Array:
    return per_env.reshape(-1, *[1] * (like.ndim - 1))
