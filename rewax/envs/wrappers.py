"""Wrappers of environments: ``Vmap`` for a batch, ``AutoReset`` to begin an episode when one ends."""

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.base import ArraySpec, Env, State
from rewax.physics.numerics.checks import shown
from rewax.short_repr import short_repr
from rewax.types import Array, Key, PyTree

NOT_FORWARDED = ("env", "made_by", "env_axis")
"""Attributes that a wrapper does not take from its environment: ``rewax.make`` did not build what is wrapped around,
and what is around a batch is none."""


def forwarded(wrapper: Any, name: str, *own: str) -> Any:
    """An attribute of the environment inside a wrapper, for the wrapper's ``__getattr__``.

    Python calls ``__getattr__`` also if a property of the wrapper raised AttributeError: it is then raised again.

    Args:
      wrapper: has the field ``env``.
      name: of the attribute.
      own: names besides ``NOT_FORWARDED`` that the environment does not stand in for.
    """
    if hasattr(type(wrapper), name):
        return object.__getattribute__(wrapper, name)
    if name.startswith("_") or name in (*NOT_FORWARDED, *own):
        raise AttributeError(name)
    return getattr(wrapper.env, name)


def select(condition: Array, on_true: PyTree, on_false: PyTree) -> PyTree:
    """``jnp.where`` over trees that may hold PRNG keys. Gradient: flows to the chosen tree only.

    Args:
      condition: shape ().
      on_true, on_false: trees of one structure.
    """

    def choose(a: Array, b: Array) -> Array:
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            data = jnp.where(condition, jax.random.key_data(a), jax.random.key_data(b))
            return jax.random.wrap_key_data(data, impl=jax.random.key_impl(a))
        return jnp.where(condition, a, b)

    return jax.tree.map(choose, on_true, on_false)


@jax.custom_batching.custom_vmap
def any_in_batch(condition: Array) -> Array:
    """Whether a condition holds in any element of the batch that ``jax.vmap`` maps over.

    The result has no axis of the batch. So ``jax.lax.cond`` on it stays a branch under ``vmap``; on a condition with
    that axis it computes both branches and selects. Elements must not depend on each other: use the result only to
    leave out what no element uses. Without ``vmap`` it is the condition itself.

    Args:
      condition: shape (), bool.
    """
    return condition


@any_in_batch.def_vmap
def _any_in_batch(axis_size: int, in_batched: list[bool], condition: Array) -> tuple[Array, bool]:
    del axis_size, in_batched
    return any_in_batch(jnp.any(condition)), False


def observed_names(env: Any, of: Iterable[str] | str | None) -> tuple[str, ...] | None:
    """``of``, the observations that a wrapper is given, as a tuple of names; None stands for all.

    Raises:
      ValueError: these are no names, or one of them is not observed.
    """
    if of is None:
        return None
    if not isinstance(of, Iterable):
        raise ValueError(f"of is {shown(of)}: give names of observations, or None for all")
    names, known = (of,) if isinstance(of, str) else tuple(of), env.observation_spec
    for name in names:
        if name not in known:
            raise ValueError(f"of has {name!r}, which is not observed: use some of {', '.join(known)}")
    return names


def count_inside(env: Any, kind: type) -> int:
    """How many environments of a kind this one is wrapped around."""
    count, env = 0, getattr(env, "env", None)
    while env is not None:
        count += isinstance(env, kind)
        env = getattr(env, "__dict__", {}).get("env")
    return count


def is_or_contains(env: Any, kind: type) -> bool:
    """Whether an environment, or one that it is wrapped around, is of a kind."""
    return isinstance(env, kind) or count_inside(env, kind) > 0


def check_inside(wrapper: Any) -> None:
    """Raises ValueError if a wrapper of one running episode is around ``AutoReset`` or a batch."""
    name = type(wrapper).__name__
    if count_inside(wrapper, AutoReset):
        raise ValueError(f"{name} is around AutoReset: put AutoReset outside, AutoReset(env={name}(env=...))")
    if count_inside(wrapper, Vmap):
        raise ValueError(f"{name} is around a batch of environments: wrap each environment, then stack or Vmap")


def check_began(wrapper: Any, holds: bool) -> None:
    """Raises ValueError unless a state holds what the ``reset`` of a wrapper adds to it."""
    if not holds:
        name = type(wrapper).__name__
        raise ValueError(f"the state is not of this {name}: begin with reset of the {name}, not of what is inside")


def is_number(leaf: Any) -> bool:
    """Whether a leaf is a Python number: a constant of the program that all environments of a batch share."""
    return isinstance(leaf, (bool, int, float))


@struct.dataclass
class _Wrapper:
    """Base of wrappers: forwards every property and method to ``env``."""

    env: Any

    @property
    def observation_spec(self) -> dict[str, ArraySpec]:
        return self.env.observation_spec

    @property
    def action_spec(self) -> ArraySpec:
        return self.env.action_spec

    @property
    def episode_length(self) -> int:
        return self.env.episode_length

    @property
    def control_dt(self) -> Any:
        """Duration of a control step [s]; an AttributeError if the environment has none."""
        return self.env.control_dt

    @property
    def unwrapped(self) -> Env:
        """The innermost environment."""
        return getattr(self.env, "unwrapped", self.env)

    def __repr__(self) -> str:
        return short_repr(self, first=_own_observation(self))

    def reset(self, key: Key) -> State:
        return self.env.reset(key)

    def step(self, state: State, action: Array) -> State:
        return self.env.step(state, action)


def _own_observation(wrapper: _Wrapper) -> list[str]:
    """The shapes of a wrapper's observation, for its text, if they are not those of its environment."""
    try:
        own, inner = (
            {name: spec.shape for name, spec in env.observation_spec.items()} for env in (wrapper, wrapper.env)
        )
    except Exception:  # a batch of environments, a tree without arrays: their text must not raise
        return []
    return [] if own == inner else [f"observation={own}"]


@struct.dataclass
class AutoReset(_Wrapper):
    """Begins a new episode in the step that ends one.

    After such a step, reward, terminated, truncated, metrics and status belong to the old episode; obs, physics and
    step_count belong to the new one. ``final_obs`` is the last observation of the old episode. Every reset draws a new
    initial state. A step in which no episode of the batch ends computes no reset.

    Gradient: exact through the step. The first state of a new episode is a constant, also with respect to the
      parameters of the environment. Other environments of a batch are not affected.

    Raises:
      ValueError: the environment has an ``AutoReset`` already, or is a batch.
    """

    def __post_init__(self) -> None:
        if count_inside(self, AutoReset):
            raise ValueError("the environment has an AutoReset already: give it without, one resets all")
        if count_inside(self, Vmap):
            raise ValueError("AutoReset is around a batch: put Vmap outside, Vmap(env=AutoReset(env=...))")

    def reset(self, key: Key) -> State:
        state = self.env.reset(key)
        return state.replace(final_obs=state.obs)

    def step(self, state: State, action: Array) -> State:
        state = self.env.step(state.replace(final_obs=None), action)
        key, reset_key = jax.random.split(state.key)
        kept = _of_episode(state)

        def constant(fresh: PyTree) -> PyTree:
            # The choice is made in both branches, which then agree on the mesh axes along which values differ.
            return jax.lax.stop_gradient(select(state.done, fresh, kept))

        fresh = jax.lax.cond(
            any_in_batch(state.done),
            lambda: constant(_of_episode(self.env.reset(reset_key).replace(key=key))),
            lambda: constant(kept),
        )
        return state.replace(**select(state.done, fresh, kept), final_obs=state.obs)


def _of_episode(state: State) -> dict[str, PyTree]:
    """The parts of a state that belong to its episode."""
    return {name: getattr(state, name) for name in ("physics", "obs", "step_count", "key", "drawn", "delayed")}


@struct.dataclass
class Vmap(_Wrapper):
    """A batch of environments: every argument and result has a leading axis of environments.

    Attributes:
      env: one environment that serves for the whole batch, or a batch of parameters: an environment whose arrays have
        a leading axis of environments, see ``stack``.
      env_axis: 0 for a batch of parameters, None for one environment (static).
    """

    env_axis: int | None = struct.static_field(default=None)

    def __post_init__(self) -> None:
        if self.env_axis not in (None, 0):
            raise ValueError(f"env_axis is {self.env_axis}: give 0 for a batch of environments, None for one")

    @property
    def observation_spec(self) -> dict[str, ArraySpec]:
        return self._first.observation_spec

    @property
    def action_spec(self) -> ArraySpec:
        return self._first.action_spec

    @property
    def episode_length(self) -> int:
        return self._first.episode_length

    def reset(self, key: Key) -> State:
        """key: shape (num_envs,). Raises ValueError for a single key."""
        from rewax.envs.kit.checks import check_keys  # here, because importing rewax.envs imports no part of a task

        check_keys(key)
        return jax.vmap(lambda env, key: env.reset(key), in_axes=(self._axes, 0))(self.env, key)

    def step(self, state: State, action: Array) -> State:
        """action: shape (num_envs, *action_shape). Raises ValueError for another number of actions than of states."""
        num = np.shape(state.step_count)[:1]
        check_began(self, num != ())
        for leaf in jax.tree.leaves(action):
            if np.shape(leaf)[:1] != num:
                raise ValueError(
                    f"the action has shape {np.shape(leaf)} for {num[0]} environments: give one action for each, shape "
                    f"{(*num, *self.action_spec.shape)}"
                )
        return jax.vmap(lambda env, *args: env.step(*args), in_axes=(self._axes, 0, 0))(self.env, state, action)

    @property
    def _axes(self) -> Any:
        """``in_axes`` of ``jax.vmap`` for the environment. Python numbers have no axis."""
        if self.env_axis is None:
            return None
        return jax.tree.map(lambda a: None if is_number(a) else 0, self.env)

    @property
    def _first(self) -> Any:
        if self.env_axis is None:
            return self.env
        return jax.tree.map(lambda a: a if is_number(a) else a[0], self.env)
