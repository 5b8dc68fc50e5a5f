"""Is every gradient finite? The gradient of a 32-step return with respect to everything, over many seeds.

For each seed: a reset, a random action sequence, and the derivative of the return by every action and by every leaf of
the environment (material, gravity, shapes, friction, masses, rest positions, ...).

    python benchmarks/gradient_health.py --seeds 100
    python benchmarks/gradient_health.py --env AntRun --seeds 2000 --at-once 100
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import rewax
from rewax.status import all_finite
from rewax.training import enable_compilation_cache


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this check."""

    env: str = "RollingFlat"
    scale: str = "small"
    seeds: int = 100
    steps: int = 32
    at_once: int = 25
    """Seeds simulated side by side."""


def main(args: Args) -> int:
    enable_compilation_cache()
    env = rewax.make(args.env, scale=args.scale)
    # The pin has to be pressed down to touch the dough.
    bias = jnp.asarray([0.0, -0.7, 0.0]) if args.env == "RollingFlat" else 0.0

    def total_return(env, actions, key):
        def step(state, action):
            state = env.step(state, action)
            return state, state.reward

        return jax.lax.scan(step, env.reset(key), actions)[1].sum()

    def check(seed):
        reset_key, action_key = jax.random.split(jax.random.key(seed))
        noise = jax.random.uniform(action_key, (args.steps, *env.action_spec.shape), minval=-1.0, maxval=1.0)
        grads = jax.grad(total_return, argnums=(0, 1), allow_int=True)(env, noise + bias, reset_key)
        leaves = [leaf for leaf in jax.tree.leaves(grads) if leaf.dtype != jax.dtypes.float0 and leaf.size]
        finite = jnp.stack([all_finite(leaf) for leaf in leaves])
        used = jnp.stack([jnp.any(leaf != 0) for leaf in leaves])
        return finite, jnp.linalg.norm(grads[1]), used

    run = jax.jit(jax.vmap(check))
    parts = [run(jnp.arange(i, i + args.at_once)) for i in range(0, args.seeds, args.at_once)]
    finite, action_norm, used = (np.concatenate([np.asarray(p[k]) for p in parts]) for k in range(3))
    bad = int((~finite).sum())
    print(f"{args.env}, {finite.shape[0]} seeds, {finite.shape[1]} parameters each: {bad} gradients are not finite")
    print(f"gradient by actions, norm: median {np.median(action_norm):.3g}, largest {action_norm.max():.3g}")
    print(f"parameters with a gradient: {int(used.any(axis=0).sum())} in a seed, {int(used.all(axis=0).sum())} in all")
    return bad


if __name__ == "__main__":
    raise SystemExit(min(main(tyro.cli(Args, description=__doc__)), 1))
