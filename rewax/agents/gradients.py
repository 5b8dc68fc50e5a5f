"""Gradients through rollouts, one per environment, so that a non-finite one does not reach the others."""

from collections.abc import Callable
from typing import Literal, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import optax

from rewax.agents.base import Metrics
from rewax.agents.devices import check_closes_over_no_array
from rewax.agents.legal import EnvLimit
from rewax.agents.optimizers import Packing
from rewax.agents.run_state import Environments, RunState
from rewax.envs.base import State
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, PyTree

R = TypeVar("R", bound=RunState)
D = TypeVar("D")

Loss: TypeAlias = Callable[[PyTree, R, AutoReset, State, Key], tuple[Array, D]]
"""``(params, common, env, env_state, key) -> (loss, data)`` for one environment; common: ``RunState.common()``."""


def per_env_gradients(
    loss: Loss[R, D], params: PyTree, common: R, environments: Environments, key: Key
) -> tuple[Array, D, PyTree]:
    """Loss, data and gradient of every environment.

    Args:
      loss: loss of one environment behind ``AutoReset``, starting from its state. A module-level function with its
        configuration bound by ``functools.partial``. It gets arrays through its arguments only.
      params: the gradient is taken with respect to these.
      common: everything else that all environments share, ``RunState.common()``.
      environments: the ``num_envs`` environments.
      key: split into one key per environment.

    Returns:
      Losses, shape (num_envs,); data, with gradients stopped; gradients. All have a leading axis of environments.

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


def mean_gradient(losses: Array, grads: PyTree, *, max_norm: EnvLimit = None) -> tuple[PyTree, Metrics]:
    """Mean of the environments' finite gradients, and its metrics.

    Args:
      losses, grads: from ``per_env_gradients``.
      max_norm: limit of each environment's gradient before the mean; None: no clipping.

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
    """Mean gradient over the environments with a finite loss and gradient, see ``finite_per_env``.

    Args:
      losses: shape (num_envs,).
      grads: arrays with a leading axis of environments.

    Returns:
      The mean, zero if no environment is left; and a mask of the environments in the mean, shape (num_envs,), bool.
    """
    kept = finite_per_env(losses, grads)
    count = jnp.maximum(kept.sum(), 1)

    def mean(g: Array) -> Array:
        return jnp.sum(jnp.where(_expand(kept, g), g, 0.0), axis=0) / count

    return jax.tree.map(mean, grads), kept


def finite_per_env(losses: Array, grads: PyTree) -> Array:
    """Whether loss and norm of the gradient are finite, shape (num_envs,), bool.

    A gradient of finite numbers whose norm overflows would stop an optimizer: it divides by the norm or the square.
    """
    return jnp.isfinite(losses) & jnp.isfinite(jax.vmap(optax.tree.norm)(grads))


def clip_per_env(grads: PyTree, max_norm: float | Literal["median"]) -> PyTree:
    """Clips the global norm of each environment's gradient to ``max_norm``, see ``EnvLimit``.

    A gradient becomes NaN if it or its norm is not finite. ``mean_of_finite`` leaves it out.
    """
    return scaled_per_env(grads, clip_scale(grads, max_norm))


def clip_scale(grads: PyTree, max_norm: float | Literal["median"]) -> Array:
    """The factor of each environment's gradient in ``clip_per_env``, shape (num_envs,)."""
    norms = jax.vmap(optax.tree.norm)(grads)
    if max_norm == "median":  # zeros are left out: where most environments feel nothing, the others still learn
        limit = jnp.nanmedian(jnp.where((norms > 0) & jnp.isfinite(norms), norms, jnp.nan))
    else:
        limit = max_norm
    scale = jnp.where(norms > 0, jnp.minimum(1.0, limit / jnp.where(norms > 0, norms, 1.0)), 1.0)
    return jnp.where(jnp.isfinite(norms), scale, jnp.nan)


def scaled_per_env(grads: PyTree, scale: Array) -> PyTree:
    """Arrays with a leading axis of environments, times one factor for each, shape (num_envs,)."""
    return jax.tree.map(lambda g: g * _expand(scale, g), grads)


def _expand(per_env: Array, like: Array) -> Array:
    return per_env.reshape(-1, *[1] * (like.ndim - 1))
