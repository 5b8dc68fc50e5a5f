"""Memory of a policy, carried by the environment that it acts in: an observation that only the policy writes."""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax.numpy as jnp

from rewax import struct
from rewax.envs.base import MEMORY_LEAF, ArraySpec, Env, State, with_first_observations, with_observations
from rewax.envs.kit.checks import as_numbers
from rewax.envs.kit.options import integer_option
from rewax.envs.wrappers import _Wrapper, check_began, check_inside
from rewax.status import FATAL
from rewax.types import Array, Key

MEMORY = "memory"
"""The name of the observation that holds the memory."""


class Remembered(NamedTuple):
    """Result of a policy with memory: an action, and the memory that it has at the next step."""

    action: Array
    memory: Array


@struct.dataclass
class Remembering(struct.Replaceable, _Wrapper):
    """An environment that carries the memory of a policy as the observation ``memory``.

    ``reset`` sets it to its start. ``step`` takes ``Remembered(action, memory)`` and shows this memory beside the next
    observation. Behind ``AutoReset`` a new episode therefore begins with it, in its own environment only, and the
    memory is a part of the state that checkpoints and devices hold. A memory that is not finite fails the step, as an
    observation does. After a numerical failure the memory keeps its value.

    Attributes:
      env: an environment without auto-reset.
      size: number of components of the memory (static).
      start: the memory at the beginning of an episode, shape (size,); None: zeros.

    Gradient: exact, through the memory to the steps that wrote it.

    Raises:
      ValueError: ``size`` is no integer of at least 1, ``start`` has another shape, or the wrapper is around
        ``AutoReset`` or a batch. ``step``: the action is no ``Remembered``, its memory has another shape, or the state
        is that of ``env`` alone.
    """

    size: int = struct.static_field(default=1)
    start: Array | None = None

    def __post_init__(self) -> None:
        check_inside(self)
        size = integer_option("size", self.size, "give the number of components of the memory")
        object.__setattr__(self, "size", size)
        if self.start is not None:
            object.__setattr__(self, "start", self._checked("start", self.start))

    @property
    def observation_spec(self) -> dict[str, ArraySpec]:
        return {**self.env.observation_spec, MEMORY: ArraySpec((self.size,))}

    def reset(self, key: Key) -> State:
        state = self.env.reset(key)
        start = jnp.zeros(self.size) if self.start is None else self.start
        return with_first_observations(state, {MEMORY: start.astype(state.reward.dtype)}, leaf=MEMORY_LEAF)

    def _checked(self, name: str, memory: Any) -> Array:
        """The memory as an array. Raises ValueError if it has another shape than ``(size,)``."""
        remedy = f"give numbers of shape ({self.size},)"
        memory = as_numbers(name, memory, remedy)
        if memory.shape != (self.size,):
            raise ValueError(f"{name} has shape {memory.shape}: {remedy}")
        return memory

    def step(self, state: State, action: Remembered) -> State:  # type: ignore[override]
        if not isinstance(action, Remembered):
            raise ValueError(
                f"the policy returned {type(action).__name__}, but it has a memory of {self.size}: let it return "
                "Remembered(action, memory), or give memory=0"
            )
        check_began(self, MEMORY in state.obs)
        memory = self._checked("the memory that the policy returned", action.memory)
        own = {name: value for name, value in state.obs.items() if name != MEMORY}
        new = self.env.step(state.replace(obs=own), action.action)
        failed = (new.status & int(FATAL)) != 0
        memory = jnp.where(failed, state.obs[MEMORY], memory.astype(state.obs[MEMORY].dtype))
        return with_observations(new, {MEMORY: memory}, state.obs, leaf=MEMORY_LEAF)


def check_no_memory(env: Env) -> None:
    """Raises ValueError if the environment has an observation with the name of the memory already."""
    if MEMORY in env.observation_spec:
        raise ValueError(
            f"the environment has an observation named {MEMORY!r}, the name of a policy's memory: rename it, or give "
            "memory=0"
        )


def remembering(env: Env, size: int, start: Array | None = None) -> Remembering:
    """The environment with a memory of ``size`` components that begins as ``start``, by default with zeros.

    Raises:
      ValueError: it has an observation of that name already.
    """
    check_no_memory(env)
    return Remembering(env=env, size=size, start=start)


def remembered(action: Array, memory: Array | None) -> Any:
    """Result of a policy: the action alone, if it has no memory."""
    return action if memory is None else Remembered(action, memory)


def action_of(moved: Any) -> Array:
    """The action that a policy returned, with or without memory."""
    return moved.action if isinstance(moved, Remembered) else moved


def initial_memory(policy: Callable[..., Any]) -> Array | None:
    """The memory with which a policy begins an episode; None if it has none."""
    start = getattr(policy, "initial_memory", None)
    return None if start is None else start()


def stage(env: Any, policy: Callable[..., Any]) -> Any:
    """The environment as a policy acts in it: with a memory, if the policy has one.

    Raises:
      ValueError: ``initial_memory()`` has not one axis, or the environment has an observation ``memory`` already.
    """
    memory = initial_memory(policy)
    if memory is None:
        return env
    if jnp.ndim(memory) != 1:
        raise ValueError(f"initial_memory() of the policy has shape {jnp.shape(memory)}: return one of shape (size,)")
    return remembering(env, len(memory), jnp.asarray(memory))


def with_memory_of(policy: Callable[..., Any], function: Callable[..., Any]) -> Callable[..., Any]:
    """``function``, marked as a policy that has the memory of ``policy``."""
    if hasattr(policy, "initial_memory"):
        cast(Any, function).initial_memory = cast(Any, policy).initial_memory
    return function


__all__ = [
    "MEMORY", "Remembered", "Remembering", "action_of", "check_no_memory", "initial_memory", "remembered",
    "remembering", "stage", "with_memory_of",
]  # fmt: skip
