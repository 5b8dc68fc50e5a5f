"""Mistakes in the arguments of an environment's methods, said in one sentence."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.base import ArraySpec


def check_action(action: Any, spec: ArraySpec) -> None:
    """Whether an action has the shape of one environment's action.

    Raises:
      ValueError: otherwise.
    """
    if np.shape(action) != spec.shape:
        raise ValueError(
            f"the action has shape {np.shape(action)}: give shape {spec.shape}, and jax.vmap over step for a batch"
        )


def check_key(key: Any) -> None:
    """Whether a key is one random key of JAX, typed (``jax.random.key``) or raw (``jax.random.PRNGKey``).

    Raises:
      ValueError: otherwise.
    """
    typed = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    raw = isinstance(key, (jax.Array, np.ndarray)) and key.dtype == np.uint32 and key.ndim >= 1
    if not typed and not raw:
        raise ValueError(f"the key is {_described(key)}: give a random key, jax.random.key(0) for example")
    shape = key.shape if typed else key.shape[:-1]
    if shape != ():
        raise ValueError(f"the key holds keys of shape {shape}: give one key, and jax.vmap over reset for a batch")


def _described(value: Any) -> str:
    """A short value itself, an array by type and shape."""
    if isinstance(value, (jax.Array, np.ndarray)):
        return f"an array of {value.dtype} of shape {value.shape}"
    return repr(value) if isinstance(value, (bool, int, float, str, type(None))) else f"a {type(value).__name__}"
