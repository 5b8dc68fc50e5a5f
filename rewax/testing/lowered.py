"""Which programs of an environment run in C++ on a CPU, and why others run in XLA."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.lowering import machine
from rewax.lowering.report import Decision, recorded
from rewax.types import Array


def where_it_runs(env: Env) -> list[Decision]:
    """Lower a step of an environment and its derivatives, and list where each program of each function runs.

    Nothing is compiled or run. The derivatives, forward and reverse, are those of the returned state with respect to
    state, action and parameters.

    Args:
      env: unbatched environment.

    Returns:
      One decision for each function, program (value, jvp, vjp) and reason, sorted. ``reason`` is None in C++.

    Raises:
      ValueError: JAX does not compute on a CPU, or C++ is switched off or cannot be built.

    Example:
      >>> assert not [decision for decision in where_it_runs(env) if decision.reason]
    """
    if jax.default_backend() != "cpu":
        raise ValueError(f"JAX computes on a {jax.default_backend()}, and C++ is for a CPU: set JAX_PLATFORMS=cpu")
    if (reason := machine.why_in_xla()) is not None:
        raise ValueError(f"all functions run in XLA ({reason}): rewax doctor says what to do")
    leaves = EnvLeaves.of(env)
    state = jax.eval_shape(lambda leaves, key: leaves.build().reset(key), leaves, jax.random.key(0))
    action = jax.ShapeDtypeStruct(env.action_spec.shape, jnp.result_type(float))

    def step(leaves: EnvLeaves, state: State, action: Array) -> State:
        return leaves.build().step(state, action)

    return decisions_of(step, leaves, state, action)


def decisions_of(function: Callable[..., Any], *args: Any) -> list[Decision]:
    """Lower the derivatives of a function's floats by all floats of its arguments, and list where each rule runs.

    Args:
      function: of pytrees of arrays.
      *args: arrays, or their shapes and types.
    """

    def floats(*args: Any) -> list[Array]:
        return [a for a in jax.tree.leaves(function(*args)) if jnp.issubdtype(a.dtype, jnp.floating)]

    def forward(*args: Any) -> Any:
        return jax.jvp(floats, args, jax.tree.map(_tangent, args))

    def reverse(*args: Any) -> Any:
        def total(*args: Any) -> Array:
            return sum(jnp.sum(a) for a in floats(*args))  # type: ignore[return-value]

        return jax.grad(total, argnums=tuple(range(len(args))), allow_int=True)(*args)

    with recorded() as decisions:
        for derivative in (forward, reverse):
            jax.jit(derivative).lower(*args)
    return sorted(set(decisions), key=lambda d: (d.function, d.rule, d.reason or ""))


def _tangent(a: Array) -> Any:
    """A tangent that is not known to be zero, so that no derivative is left out."""
    return a if jnp.issubdtype(a.dtype, jnp.floating) else np.zeros(a.shape, jax.dtypes.float0)


__all__ = ["decisions_of", "where_it_runs"]
