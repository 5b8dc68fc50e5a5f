"""How the gradient of a return grows with the number of control steps that it goes back.

    python benchmarks/gradient_growth.py
    python benchmarks/gradient_growth.py --tasks CoverBox --scale paper --episodes 4
    python benchmarks/gradient_growth.py --tasks CoverBox FoldCloth --rate 200     # hands jump to their set points

For episodes of small random actions: the norm of the derivative of the last reward by the action of each earlier step,
its median over episodes. Printed is the norm 1, 5, 10, 20 and 40 steps before the end, and the growth per step between
5 and 20. Where the growth is well above 1, whole episodes give gradients that point nowhere; short horizons help.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import rewax
from rewax.envs.base import Env
from rewax.training import enable_compilation_cache

BACK = (1, 5, 10, 20, 40)
"""Steps before the end."""
SIZE = 0.3
"""Standard deviation of the actions."""


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the benchmark."""

    tasks: tuple[str, ...] = ("WhipRope", "CoverBox", "FoldCloth", "PourBag", "RollingFlat", "HandFlip")
    scale: str = "small"
    episodes: int = 8
    rate: float | None = None
    """Angular frequency with which joints follow their set points [rad/s]; None: the task's."""


def norms(env: Env, episodes: int) -> np.ndarray:
    """Median norm of the derivative of the last reward by each action, shape (steps,), the last action first."""
    steps = env.episode_length

    def last(actions, key):
        def step(state, action):
            state = env.step(state, action)
            return state, state.reward

        return jax.lax.scan(jax.checkpoint(step), env.reset(key), actions)[1][-1]

    keys = jax.random.split(jax.random.key(0), (2, episodes))
    actions = SIZE * jax.vmap(lambda key: jax.random.normal(key, (steps, *env.action_spec.shape)))(keys[0])
    gradients = jax.jit(jax.vmap(jax.grad(last)))(jnp.clip(actions, -1.0, 1.0), keys[1])
    return np.median(np.linalg.norm(np.asarray(gradients, np.float64), axis=-1), axis=0)[::-1]


def main(args: Args) -> None:
    enable_compilation_cache()
    print("| task | " + " | ".join(f"{k} before the end" for k in BACK) + " | growth per step |")
    print("|" + "---|" * (len(BACK) + 2))
    for task in args.tasks:
        env = rewax.make(task, scale=args.scale)
        if args.rate is not None:
            env = rewax.replace_leaf(env, "rate", args.rate)
        found = norms(env, args.episodes)
        cells = [f"{found[k - 1]:.2g}" if k <= len(found) else "-" for k in BACK]
        growth = (found[19] / found[4]) ** (1 / 15) if len(found) >= 20 else np.nan
        print(f"| {task} | {' | '.join(cells)} | {growth:.2f} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
