"""A policy acting in one environment, differentiably."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from rewax.envs.base import Env, State
from rewax.status import FATAL
from rewax.types import Array, Key, Observation, PyTree

Differentiation = Literal["full", "checkpointed", "none"]
"""How a rollout is differentiated: store everything, recompute each step from its state, or cut all gradients."""


class Transition(NamedTuple):
    """One step. ``rollout`` returns transitions with a leading axis of time.

    Attributes:
      obs: observation before the step.
      action: result of the policy: an action, shape (action_size,), or ``Remembered(action, memory)``.
      reward: shape ().
      next_obs: observation after the step, before any reset.
      terminated, truncated: how the episode ended, shape (), bool.
      status: bits of ``Status``, shape (), int32.
      failed_leaf: see ``State.failed_leaf``, shape (), int32.
      metrics: of the environment, shape () each.
      aux: auxiliary outputs of the policy, e.g. its entropy.
      active: False after the rollout's ``num_active`` steps, where the environment stands still, shape (), bool. Such
        steps must be masked.
    """

    obs: Observation
    action: Any
    reward: Array
    next_obs: Observation
    terminated: Array
    truncated: Array
    status: Array
    failed_leaf: Array
    metrics: dict[str, Array]
    aux: dict[str, Array]
    active: Array

    @property
    def done(self) -> Array:
        """The episode ended: it terminated or was truncated."""
        return self.terminated | self.truncated

    @property
    def failed(self) -> Array:
        """The step failed numerically."""
        return (self.status & int(FATAL)) != 0

    @property
    def begins(self) -> Array:
        """The step is the first of the rollout or of an episode; the last axis is time."""
        return jnp.roll(self.done, 1, axis=-1).at[..., 0].set(True)

    @property
    def valid(self) -> Array:
        """The step is active and did not fail. A failed step has no reward and no next value."""
        return self.active & ~self.failed


Policy = Callable[..., tuple[Any, dict[str, Array]]]
"""``(obs, key) -> (action, aux)``, or ``(obs, key, input) -> (action, aux)`` in a rollout with ``inputs``. With memory,
``Remembered(action, memory)`` takes the place of ``action``."""


def rollout(
    env: Env,
    state: State,
    policy: Policy,
    key: Key,
    *,
    horizon: int,
    differentiate: Differentiation = "checkpointed",
    truncate_every: int | None = None,
    state_gradient_decay: float | Array = 1.0,
    inputs: PyTree = None,
    num_active: Array | None = None,
    probes: Array | None = None,
) -> tuple[State, Transition]:
    """Act for ``horizon`` steps in one environment behind ``AutoReset``.

    Args:
      env: an environment whose states carry ``final_obs``.
      state: initial state.
      policy: ``(obs, key) -> (action, aux)``; with ``inputs``: ``(obs, key, input) -> (action, aux)``.
      key: key for the policy, split into one per step.
      horizon: number of steps.
      differentiate: ``"full"`` stores every intermediate value of every step, ``"checkpointed"`` stores states and
        recomputes each step in the backward pass, ``"none"`` cuts all gradients.
      truncate_every: cut the gradient of the state, including its observation, every so many steps; None: never.
      state_gradient_decay: factor on that gradient, one for all steps or one per step, shape (horizon,); 1: exact.
      inputs: additional input of the policy at each step, leading axis (horizon,).
      num_active: the environment stands still after this many steps, at most ``horizon``; None: it never does. Under
        ``vmap`` with one number for all environments, further steps are not computed.
      probes: zeros, shape (horizon,). The gradient with respect to ``probes[t]`` is the norm of the cotangent of
        state t, without that of the episode's drawn parameters (``State.drawn``).

    Returns:
      Final state, and transitions with leading axis (horizon,). Gradient: through actions, physics, observations and
      rewards, cut at the end of each episode. A decay or a truncation makes it biased.
    """
    factors = None
    if truncate_every is not None or isinstance(state_gradient_decay, jax.Array) or state_gradient_decay != 1.0:
        step_number = jnp.arange(horizon)
        cut = False if truncate_every is None else (step_number % truncate_every == 0) & (step_number > 0)
        factors = jnp.where(cut, 0.0, jnp.full(horizon, state_gradient_decay))

    active = jnp.ones(horizon, bool) if num_active is None else jnp.arange(horizon) < num_active

    def act(state: State, key: Key, own: PyTree) -> tuple[State, Any, dict[str, Array]]:
        action, aux = policy(state.obs, key) if inputs is None else policy(state.obs, key, own)
        return env.step(state, action), action, aux

    def stand_still(state: State, key: Key, own: PyTree) -> tuple[State, Any, dict[str, Array]]:
        new, *rest = jax.eval_shape(act, state, key, own)
        fields = {name: getattr(new, name) for name in ("reward", "terminated", "truncated", "status")}
        fields, (action, aux) = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), (fields, rest))
        return state.replace(**fields), action, aux

    def step(state: State, given: tuple[Key, Array | None, Array | None, PyTree, Array]) -> tuple[State, Transition]:
        key, factor, probe, own, active = given
        if probe is not None:
            state = probed(state.replace(drawn=None), probe).replace(drawn=state.drawn)
        if factor is not None:
            state = scale_gradient(state, factor)
        if num_active is None:
            new, action, aux = act(state, key, own)
        else:
            new, action, aux = jax.lax.cond(active, act, stand_still, state, key, own)
        assert new.final_obs is not None, "rollout needs an environment behind AutoReset"
        transition = Transition(
            obs=state.obs,
            action=action,
            reward=new.reward,
            next_obs=new.final_obs,
            terminated=new.terminated,
            truncated=new.truncated,
            status=new.status,
            failed_leaf=new.failed_leaf,
            metrics=new.metrics,
            aux=aux,
            active=active,
        )
        return new, transition

    body = jax.checkpoint(step, prevent_cse=False) if differentiate == "checkpointed" else step
    out = jax.lax.scan(body, state, (jax.random.split(key, horizon), factors, probes, inputs, active))
    return jax.lax.stop_gradient(out) if differentiate == "none" else out


def first_episode(transitions: Transition) -> Transition:
    """The transitions until an episode ends for the first time; later steps are inactive, and nothing happens in them.

    For sequences of actions, which do not restart with an episode.

    Args:
      transitions: the last axis of its scalars is time.
    """
    done = transitions.done
    kept = jnp.cumsum(done, axis=-1) - done == 0
    return transitions._replace(
        reward=jnp.where(kept, transitions.reward, 0.0),
        terminated=transitions.terminated & kept,
        truncated=transitions.truncated & kept,
        status=jnp.where(kept, transitions.status, 0),
        active=transitions.active & kept,
    )


def masked(tree: PyTree, valid: Array) -> PyTree:
    """The tree with zeros where ``valid`` is False. Its arrays begin with the axes of ``valid``, bool."""

    def one(a: Array) -> Array:
        return jnp.where(valid.reshape(*valid.shape, *[1] * (a.ndim - valid.ndim)), a, jnp.zeros((), a.dtype))

    return jax.tree.map(one, tree)


def scale_gradient(tree: PyTree, factor: Array) -> PyTree:
    """The same values; their gradient is multiplied by ``factor``. Gradient with respect to ``factor``: zero."""

    def scaled(factor: Array, grads: list[Array]) -> tuple[list[Array], Array]:
        # A factor of 0 cuts non-finite gradients too.
        return [jnp.where(factor == 0, 0.0, g * factor).astype(g.dtype) for g in grads], jnp.zeros_like(factor)

    return _with_backward(tree, factor, scaled)


def probed(tree: PyTree, probe: Array) -> PyTree:
    """The same values; the gradient with respect to ``probe``, shape (), is the norm of their cotangent."""

    def measured(probe: Array, grads: list[Array]) -> tuple[list[Array], Array]:
        return grads, jnp.sqrt(sum(jnp.sum(g * g) for g in grads)).astype(probe.dtype)

    return _with_backward(tree, probe, measured)


def _with_backward(tree: PyTree, scalar: Array, backward: Callable[..., tuple[list[Array], Array]]) -> PyTree:
    """The same values; ``backward(scalar, grads)`` gives the gradients with respect to floating leaves and scalar."""

    @jax.custom_vjp
    def same(floats: list[Array], scalar: Array) -> list[Array]:
        del scalar
        return floats

    same.defvjp(lambda floats, scalar: (floats, scalar), backward)
    leaves, structure = jax.tree.flatten(tree)
    floating = [i for i, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    for i, leaf in zip(floating, same([leaves[i] for i in floating], scalar), strict=True):
        leaves[i] = leaf
    return jax.tree.unflatten(structure, leaves)
