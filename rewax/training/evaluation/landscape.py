"""Returns in the neighbourhood of a policy, along two random directions of its parameters."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.base import Env
from rewax.envs.memory import with_memory_of
from rewax.training.evaluation.episodes import Policy, make_evaluate, with_step
from rewax.types import Array, Key, PyTree


class Landscape(NamedTuple):
    """Mean returns on a square grid around a policy.

    Attributes:
      offsets: along either direction, in units of the norm of the parameters, shape (size,).
      returns: mean returns with deterministic actions, shape (size, size); the first axis is the first direction.
    """

    offsets: np.ndarray
    returns: np.ndarray


def landscape(
    env: Env, policy: Policy, train_state: Any, key: Key, *, size: int = 21, span: float = 1.0, num_episodes: int = 8
) -> Landscape:
    """Evaluate a policy and its neighbours from the same initial states.

    Args:
      env: unbatched environment.
      policy: ``Agent.policy``.
      train_state: of the agent; its ``actor_params`` are shifted, or TrajOpt's ``actions``.
      key: draws the directions and the initial states.
      size: number of points along either direction; odd, so that the policy itself is in the middle.
      span: largest offset; 1: the norm of the shift equals that of the parameters, array by array.
      num_episodes: per point.

    Raises:
      ValueError: an illegal argument, or the state has no parameters of a policy.
    Source: Li et al. 2018, Visualizing the Loss Landscape of Neural Nets; directions are normalised array by array.
      Xing, Luk and Oh 2025 show returns in this way.
    """
    if size < 3 or size % 2 == 0:
        raise ValueError(f"size is {size}: give an odd number from 3 on")
    if not span > 0:
        raise ValueError(f"span is {span}: give a positive number")
    name = next((name for name in ("actor_params", "actions") if hasattr(train_state, name)), "")
    if not name:
        raise ValueError(
            f"the training state, {type(train_state).__name__}, has neither actor_params nor actions: "
            "there is nothing to shift"
        )
    params, (first_key, second_key, episode_key) = getattr(train_state, name), jax.random.split(key, 3)
    first, second = (direction(k, params) for k in (first_key, second_key))
    evaluate = make_evaluate(env, _shifted(policy, name), num_episodes)

    @jax.jit
    def row(a: Array, offsets: Array) -> Array:
        def point(b: Array) -> Array:
            shift = jax.tree.map(lambda p, u, v: p + a * u + b * v, params, first, second)
            return evaluate((train_state, shift), episode_key, deterministic=True)["mean"]

        return jax.lax.map(point, offsets)

    offsets = np.linspace(-span, span, size, dtype=np.float32)
    return Landscape(offsets, np.stack([row(a, offsets) for a in offsets]))


def direction(key: Key, params: PyTree) -> PyTree:
    """A random direction; each array has the norm of the parameters' array."""
    leaves, structure = jax.tree.flatten(params)

    def one(key: Key, leaf: Array) -> Array:
        drawn = jax.random.normal(key, leaf.shape, leaf.dtype)
        return drawn * (jnp.linalg.norm(leaf) / jnp.maximum(jnp.linalg.norm(drawn), 1e-12))

    keys = jax.random.split(key, len(leaves))
    return jax.tree.unflatten(structure, [one(k, leaf) for k, leaf in zip(keys, leaves, strict=True)])


def _shifted(policy: Policy, name: str) -> Policy:
    """The policy of ``(train_state, params)``, which uses these parameters in place of the state's."""
    policy_at = with_step(policy)

    def shifted(state_and_params: Any, obs: Any, key: Key, deterministic: bool = False, step: Any = 0) -> Any:
        train_state, params = state_and_params
        return policy_at(train_state.replace(**{name: params}), obs, key, step, deterministic)

    return with_memory_of(policy, shifted)
