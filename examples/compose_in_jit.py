"""An environment inside your own jitted code: optimise an open-loop motion of the rolling pin with optax.

The whole episode is one differentiable function of the action sequence; ``jax.grad`` differentiates every substep of
the dough. The example needs no agent and no training loop.

    python examples/compose_in_jit.py --iterations 30
"""

import dataclasses
import functools
import time

import jax
import jax.numpy as jnp
import optax
import tyro

import rewax
from rewax.training import enable_compilation_cache


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this example."""

    iterations: int = 30
    """Steps of Adam."""
    steps: int = 40
    """Control steps of the motion."""
    learning_rate: float = 0.1
    seed: int = 0


def make_objective(env: rewax.Env, start: rewax.State):
    """The mean reward of a motion as a function of raw actions (steps, action_size), which tanh maps to the bounds."""

    def step(state: rewax.State, raw: jax.Array):
        state = env.step(state, jnp.tanh(raw))
        return state, state.reward

    def objective(raw: jax.Array) -> jax.Array:
        _, rewards = jax.lax.scan(step, start, raw)
        return rewards.mean()

    return objective


def main(args: Args) -> list[float]:
    enable_compilation_cache()
    env = rewax.make("RollingFlat", scale="small")
    objective = make_objective(env, env.reset(jax.random.key(args.seed)))
    optimizer = optax.chain(optax.zero_nans(), optax.clip_by_global_norm(1.0), optax.adam(args.learning_rate))

    @functools.partial(jax.jit, donate_argnums=(0, 1))
    def update(raw, opt_state):
        value, grad = jax.value_and_grad(objective)(raw)
        updates, opt_state = optimizer.update(-grad, opt_state)
        return optax.apply_updates(raw, updates), opt_state, value

    raw = jnp.zeros((args.steps, *env.action_spec.shape))
    opt_state = optimizer.init(raw)
    print("compiling the gradient of the whole motion ...", flush=True)
    began, history = time.perf_counter(), []
    for i in range(args.iterations):
        raw, opt_state, value = update(raw, opt_state)
        history.append(float(value) * args.steps)
        print(f"{i:4d}  return {history[-1]:8.3f}  {time.perf_counter() - began:6.1f} s", flush=True)
    return history


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
