"""Compiled ``reset`` and ``step``. The parameters of the environment are arguments, as agents compile them."""

from collections.abc import Callable
from typing import Any

import jax

from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.types import Array, Key

UNTRACEABLE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.UnexpectedTracerError,
)
_REMEDY = (
    "jnp.where or lax.cond instead of if, jnp instead of numpy, .at[].set instead of assignment, and static_field() "
    "for values that shape the program"
)


def traced_reset(env: Env) -> Callable[[Key], State]:
    """``reset``, compiled once."""
    leaves, reset = EnvLeaves.of(env), jax.jit(lambda leaves, key: leaves.build().reset(key))
    return lambda key: named("reset", reset, leaves, key)


def traced_step(env: Env) -> Callable[[State, Array], State]:
    """``step``, compiled once."""
    leaves = EnvLeaves.of(env)
    step = jax.jit(lambda leaves, state, action: leaves.build().step(state, action))
    return lambda state, action: named("step", step, leaves, state, action)


def named(what: str, function: Callable[..., Any], *args: Any) -> Any:
    """``function(*args)``. Raises AssertionError with a remedy if the function cannot be traced."""
    try:
        return function(*args)
    except UNTRACEABLE as error:
        first = str(error).splitlines()[0].rstrip(".")
        raise AssertionError(f"{what} cannot be compiled with traced parameters ({first}): use {_REMEDY}") from error


def random_action(env: Env, key: Key) -> Array:
    """Uniform within the bounds of ``action_spec``."""
    spec = env.action_spec
    return jax.random.uniform(key, spec.shape, minval=spec.low, maxval=spec.high)
