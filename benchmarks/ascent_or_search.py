"""What gradients find that start from a policy's own actions, and what random sequences find, from the same states.

    python benchmarks/ascent_or_search.py
    python benchmarks/ascent_or_search.py --task SteerFloat --start 48 --steps 12

A packaged policy plays to ``start``. From there the sum of rewards of the next ``steps`` is compared: the policy's, the
best of Adam's ascent of the actions from those of the policy, and the best and the mean of random sequences that hold
each action for a while. Where random sequences find more than the ascent, the landscape has better hills elsewhere, and
a method that follows gradients needs exploration.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from rewax.envs.base import Env, State
from rewax.training import enable_compilation_cache
from rewax.training.storage.policies import open_run
from rewax.types import Array


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the benchmark."""

    task: str = "SteerFloat"
    scale: str = "small"
    start: int = 16
    steps: int = 40
    hold: int = 8
    """Steps for which a random action is held; a divisor of ``steps``."""
    sequences: int = 192
    ascents: int = 40
    """Iterations of Adam."""
    rate: float = 0.1
    """Learning rate of Adam."""
    seeds: tuple[int, ...] = (0, 1, 2)


def main(args: Args) -> None:
    enable_compilation_cache()
    saved = open_run(args.task, step=None, scale=args.scale)
    env: Env = saved.env

    @jax.jit
    def played(state: State, steps: Array) -> tuple[State, Array]:
        """The state after some steps of the deterministic policy, and the actions of all."""

        def step(state: State, k: Array) -> tuple[State, Array]:
            action = saved.agent.policy(saved.train_state, state.obs, state.key, deterministic=True)
            state = jax.tree.map(lambda new, old: jnp.where(k < steps, new, old), env.step(state, action), state)
            return state, action

        return jax.lax.scan(step, state, jnp.arange(max(args.start, args.steps)))

    def total(actions: Array, state: State) -> Array:
        """Sum of rewards."""
        body = jax.checkpoint(lambda state, action: ((new := env.step(state, action)), new.reward))
        return jnp.sum(jax.lax.scan(body, state, actions)[1])

    ascent, search = jax.jit(jax.value_and_grad(total)), jax.jit(jax.vmap(total, (0, None)))
    low, high, shape = env.action_spec.low, env.action_spec.high, env.action_spec.shape
    print("| seed | policy | ascent from it | best random | mean random |")
    print("|" + "---|" * 5)
    for seed in args.seeds:
        state, _ = played(jax.jit(env.reset)(jax.random.key(seed)), jnp.int32(args.start))
        actions = played(state, jnp.int32(args.steps))[1][: args.steps]
        optimizer = optax.adam(args.rate)
        memory, found = optimizer.init(actions), []
        for _ in range(args.ascents):
            value, gradient = ascent(actions, state)
            found.append(float(value))
            updates, memory = optimizer.update(-gradient, memory)
            actions = jnp.clip(jnp.asarray(optax.apply_updates(actions, updates)), low, high)
        draws = (args.sequences, args.steps // args.hold, *shape)
        held = jax.random.uniform(jax.random.key(seed), draws, minval=low, maxval=high)
        random = np.asarray(search(jnp.repeat(held, args.hold, axis=1), state))
        numbers = (found[0], max(found), random.max(), random.mean())
        print(f"| {seed} | " + " | ".join(f"{x:.2f}" for x in numbers) + " |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Args))
