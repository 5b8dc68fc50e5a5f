"""Evaluation: returns of policies, baselines and action sequences over whole episodes, without gradients."""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from rewax.envs.base import Env, State
from rewax.envs.memory import stage
from rewax.envs.wrappers import select
from rewax.physics.numerics.checks import static_integer
from rewax.status import FATAL, Status
from rewax.types import Array, Key, PyTree

Policy: TypeAlias = Callable[..., Array]
"""``policy(train_state, obs, key, deterministic=False) -> action``, for one environment. If the policy has a parameter
``step``, it receives the number of control steps since the episode began. If it has ``initial_memory()``, it finds its
memory in ``obs["memory"]`` and returns ``Remembered(action, memory)``, see ``rewax.envs.memory``."""
_Act: TypeAlias = Callable[[State, Array, Key], Any]

Evaluation: TypeAlias = dict[str, Array]
"""Results of the evaluated episodes:

``mean``, ``std``, ``min``, ``max``: statistics of the undiscounted returns over episodes, shape ().
``returns``: undiscounted return of each episode up to its first end, shape (num_episodes,).
``lengths``: control steps of each episode, shape (num_episodes,), int32.
``failed``: number of episodes that ended by a numerical failure, shape (), int32. Their returns end before it.
``status/<BIT>``: number of episodes in which that bit of ``rewax.status.Status`` was set, shape (), int32.
``success``: share of episodes whose metric ``success`` is above 0.5 at the end, shape (). Only for tasks with this
metric.
"""


def make_evaluate(
    env: Env, policy: Policy, num_episodes: int, *, compiler_options: Mapping[str, Any] | None = None
) -> Callable[..., Evaluation]:
    """Build a jitted ``evaluate(train_state, key, deterministic=False) -> Evaluation``.

    The ``num_episodes`` episodes run as one batch. Steps after the first end of an episode are ignored. The same key
    gives the same initial states for every policy.

    Args:
      env: unbatched environment.
      policy: ``policy(train_state, obs, key, deterministic=...) -> action`` for one environment.
      num_episodes: at least 1.
      compiler_options: of ``jax.jit``.

    Returns:
      The function. Its result is a dict: ``mean``, ``std``, ``min`` and ``max`` of the undiscounted returns, shape ();
      ``returns`` and ``lengths`` of the episodes, shape (num_episodes,); the number of episodes that ``failed``
      numerically, and that set each ``status/<BIT>``; ``success``, a share, for tasks with this metric.

    Raises:
      ValueError: ``num_episodes`` is no positive integer.

    Gradient: none.

    Example:
      >>> evaluate = make_evaluate(env, agent.policy, 64)  # doctest: +SKIP
      >>> evaluate(train_state, jax.random.key(7), deterministic=True)["mean"]  # doctest: +SKIP
      >>> nothing = constant_policy(jnp.zeros(env.action_spec.shape))  # doctest: +SKIP
      >>> make_evaluate(env, nothing, 64)(None, jax.random.key(7))["mean"]  # doctest: +SKIP
    """
    num_episodes = static_integer("num_episodes", num_episodes, 1, "give an integer of at least 1")
    policy_at = with_step(policy)

    @functools.partial(jax.jit, static_argnames="deterministic", compiler_options=dict(compiler_options or {}) or None)
    def evaluate(train_state: PyTree, key: Key, deterministic: bool = False) -> Evaluation:
        def act(state: State, step: Array, key: Key) -> Array:
            return policy_at(train_state, state.obs, jax.random.fold_in(key, step), step, deterministic)

        return _evaluate(stage(env, policy), act, key, num_episodes)

    return evaluate


def make_evaluate_in(policy: Policy, num_episodes: int) -> Callable[..., Evaluation]:
    """``make_evaluate`` with the environment as an argument.

    Environments that differ only in parameters share one compiled program.

    Returns:
      A jitted ``evaluate(env, train_state, key, deterministic=False) -> Evaluation``.

    Raises:
      ValueError: ``num_episodes`` is no positive integer.
    """
    num_episodes = static_integer("num_episodes", num_episodes, 1, "give an integer of at least 1")
    policy_at = with_step(policy)

    @functools.partial(jax.jit, static_argnames="deterministic")
    def evaluate(env: Env, train_state: PyTree, key: Key, deterministic: bool = False) -> Evaluation:
        def act(state: State, step: Array, key: Key) -> Array:
            return policy_at(train_state, state.obs, jax.random.fold_in(key, step), step, deterministic)

        return _evaluate(stage(env, policy), act, key, num_episodes)

    return evaluate


def evaluate_actions(env: Env, actions: Array, key: Key, num_episodes: int) -> Evaluation:
    """Evaluate an open-loop sequence of actions.

    Args:
      env: unbatched environment.
      actions: shape (env.episode_length, *action_shape).
      key: draws the initial states. They equal those of ``make_evaluate`` with the same key.
      num_episodes: at least 1.

    Returns:
      The dict that ``make_evaluate`` describes.

    Raises:
      ValueError: actions have another shape, or ``num_episodes`` is no positive integer.
    """
    num_episodes = static_integer("num_episodes", num_episodes, 1, "give an integer of at least 1")
    shape = (env.episode_length, *env.action_spec.shape)
    if jnp.shape(actions) != shape:
        raise ValueError(f"actions have shape {jnp.shape(actions)}: this environment needs {shape}")
    return _evaluate_sequence(env, actions, key, num_episodes)


def constant_policy(action: Array) -> Policy:
    """A baseline that always takes ``action``, of shape ``env.action_spec.shape``. Zeros: the baseline "no action"."""

    def policy(train_state: PyTree, obs: PyTree, key: Key, deterministic: bool = False) -> Array:
        del train_state, obs, key, deterministic
        return jnp.asarray(action)

    return policy


def uniform_policy(env: Env) -> Policy:
    """A baseline that draws every action uniformly within the bounds of ``env.action_spec``."""
    spec = env.action_spec

    def policy(train_state: PyTree, obs: PyTree, key: Key, deterministic: bool = False) -> Array:
        del train_state, obs, deterministic
        return jax.random.uniform(key, spec.shape, minval=spec.low, maxval=spec.high)

    return policy


@functools.partial(jax.jit, static_argnames="num_episodes")
def _evaluate_sequence(env: Env, actions: Array, key: Key, num_episodes: int) -> Evaluation:
    return _evaluate(env, lambda state, step, key: actions[step], key, num_episodes)


def _evaluate(env: Env, act: _Act, key: Key, num_episodes: int) -> Evaluation:
    keys = jax.random.split(key, num_episodes)
    returns, lengths, status, metrics = jax.vmap(lambda key: _episode(env, act, key))(keys)
    whole = (status & int(FATAL)) == 0  # after a numerical failure the metrics are those of the step before
    success = {"success": jnp.mean((metrics["success"] > 0.5) & whole)} if "success" in metrics else {}

    def count(bits: Status) -> Array:
        return jnp.sum((status & int(bits)) != 0, dtype=jnp.int32)

    return {
        "mean": jnp.mean(returns),
        "std": jnp.std(returns),
        "min": jnp.min(returns),
        "max": jnp.max(returns),
        "returns": returns,
        "lengths": lengths,
        "failed": count(FATAL),
        **{f"status/{bit.name}": count(bit) for bit in Status if bit},
        **success,
    }


def _episode(env: Env, act: _Act, key: Key) -> tuple[Array, Array, Array, dict[str, Array]]:
    """Return, length, status bits and last metrics of an episode. Steps after its first end are ignored, even NaN."""
    reset_key, act_key = jax.random.split(key)

    def body(carry: tuple[State, Array, Array, Array, Array, dict[str, Array]], step: Array) -> tuple[Any, None]:
        state, alive, total, length, status, metrics = carry
        state = env.step(state, act(state, step, act_key))
        total = total + jnp.where(alive, state.reward, 0)
        status = status | jnp.where(alive, state.status, 0)
        metrics = select(alive, state.metrics, metrics)
        return (state, alive & ~state.done, total, length + alive, status, metrics), None

    state = env.reset(reset_key)
    start = (state, jnp.bool_(True), jnp.zeros_like(state.reward), jnp.int32(0), state.status, state.metrics)
    (_, _, total, length, status, metrics), _ = jax.lax.scan(body, start, jnp.arange(env.episode_length))
    return total, length, status, metrics


def with_step(policy: Policy) -> Callable[[PyTree, Any, Key, Array, bool], Any]:
    """Wrap a policy as ``(train_state, obs, key, step, deterministic) -> action``.

    ``step`` is passed on only if the policy has a parameter of this name.
    """
    asks = "step" in inspect.signature(policy).parameters

    def policy_at(train_state: PyTree, obs: Any, key: Key, step: Array, deterministic: bool) -> Any:
        more = {"step": step} if asks else {}
        return policy(train_state, obs, key, deterministic=deterministic, **more)

    return policy_at
