"""Model-predictive control by iLQR: the simulation is the model, and forward-mode Jacobians make its steps.

At each control step the planner looks ``horizon`` steps ahead. Rewards r_t have an upper bound R, so a plan's cost is a
sum of squares, sum_t e_t^2 / 2 with e_t = sqrt(2 (R - r_t)). One Gauss-Newton step improves the plan: this is iLQR with
the states eliminated (condensed), for a state of thousands of numbers and a plan of a few dozen. The first action is
executed, and the rest, shifted by one, begins the next plan (warm start).

    python examples/ilqr.py --env RollingFlat
    python examples/ilqr.py --env FluidMove --horizon 5
"""

import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import rewax
from rewax.status import FATAL
from rewax.training import enable_compilation_cache
from rewax.types import Array

REWARD_BOUNDS = {"RollingFlat": 2.5, "FluidMove": 0.25}
"""No reward of these tasks is larger."""
DAMPINGS = np.array([1e-3, 1e-2, 1e-1, 1.0])
"""Tried side by side, in units of the largest diagonal element of the Gauss-Newton matrix."""


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this example."""

    env: str = "RollingFlat"
    scale: str = "small"
    horizon: int = 12
    """Control steps of a plan."""
    iterations: int = 1
    """Gauss-Newton steps for each control step."""
    first_iterations: int = 6
    """For the first one, whose plan begins with zeros."""
    bound: float | None = None
    """Upper bound of a step's reward; without it, that of a known task."""
    steps: int = 0
    """Control steps; 0: an episode."""
    seed: int = 0


@jax.jit
def reset(env: Any, key: Array) -> Any:
    return env.reset(key)


@jax.jit
def step(env: Any, state: Any, action: Array) -> Any:
    return env.step(state, action)


@jax.jit
def errors_and_jacobian(env: Any, state: Any, plan: Array, bound: float) -> tuple[Array, Array]:
    """Errors e_t, shape (horizon,), and their derivatives by the plan, shape (horizon, horizon, num_actions)."""

    def errors(plan: Array) -> tuple[Array, Array]:
        e = jnp.sqrt(2.0 * (bound - rewards(env, state, plan)[0]))
        return e, e

    jacobian, e = jax.jacfwd(errors, has_aux=True)(plan)
    return e, jacobian


@jax.jit
def returns(env: Any, state: Any, plans: Array) -> Array:
    """Sums of rewards of plans, (n, horizon, num_actions) -> (n,); minus infinity after a failed step."""
    steps, failed = jax.vmap(lambda plan: rewards(env, state, plan))(plans)
    return jnp.where(failed.any(axis=1), -jnp.inf, steps.sum(axis=1))


def rewards(env: Any, state: Any, plan: Array) -> tuple[Array, Array]:
    """Rewards of a plan, and whether each step failed numerically, shape (horizon,) each. A failed step has reward 0.

    Gradient: exact, through the physics.
    """

    def step(state: Any, action: Array) -> tuple[Any, tuple[Array, Array]]:
        state = env.step(state, action)
        return state, (state.reward, (state.status & FATAL) != 0)

    return jax.lax.scan(step, state, plan)[1]


def improved(env: Any, state: Any, plan: np.ndarray, bound: float) -> np.ndarray:
    """The best of the plan itself and of a Gauss-Newton step from it with each damping."""
    spec = env.action_spec
    e, jacobian = (np.asarray(a, float) for a in errors_and_jacobian(env, state, jnp.asarray(plan), bound))
    flat = jacobian.reshape(len(e), -1)
    if not np.isfinite(flat).all():
        return plan
    hessian, gradient = flat.T @ flat, flat.T @ e
    unit = max(float(np.diag(hessian).max()), 1e-12) * np.eye(len(hessian))
    moves = [np.linalg.solve(hessian + damping * unit, -gradient).reshape(plan.shape) for damping in DAMPINGS]
    plans = np.clip(np.stack([0.0 * plan, *moves]) + plan, spec.low, spec.high).astype(np.float32)
    return plans[int(np.argmax(returns(env, state, jnp.asarray(plans))))]


def main(args: Args) -> tuple[float, float]:
    """Control an episode; returns the sum of rewards, and the seconds of planning and acting with compiled programs."""
    bound = REWARD_BOUNDS.get(args.env) if args.bound is None else args.bound
    if bound is None:
        raise ValueError(f"the largest reward of {args.env} is not known here: give --bound")
    env: Any = rewax.make(args.env, scale=args.scale)
    state = reset(env, jax.random.key(args.seed))
    plan = np.zeros((args.horizon, *env.action_spec.shape), np.float32)
    step(env, state, jnp.asarray(improved(env, state, plan, bound)[0]))  # compiles
    total, began, num_steps = 0.0, time.perf_counter(), args.steps or env.episode_length
    for n in range(num_steps):
        for _ in range(args.iterations if n else args.first_iterations):
            plan = improved(env, state, plan, bound)
        state = step(env, state, jnp.asarray(plan[0]))
        total += float(state.reward)
        plan = np.concatenate([plan[1:], plan[-1:]])
        if n % 10 == 9 or n == num_steps - 1 or state.done:
            print(f"step {n + 1:3d}  return {total:8.3f}  {time.perf_counter() - began:6.1f} s", flush=True)
        if state.done:
            break
    return total, time.perf_counter() - began


if __name__ == "__main__":
    enable_compilation_cache()
    main(tyro.cli(Args))
