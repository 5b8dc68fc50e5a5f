"""How far float32 is off: gradients of one control step beside float64, and volume that dough in free fall loses.

For each seed the task runs for some steps, so that tools touch the dough and it yields. From each state on the way one
step is taken in float32 and, from the same numbers, in float64. Printed is |g32 - g64| / |g64| of the gradient of the
reward, by each leaf of the state and by the actions, and how many particles are needed for nine tenths of the squared
error: a contact or a yield surface may lie between the two precisions, and the particles there take different branches.

    python benchmarks/float32_gradients.py
    python benchmarks/float32_gradients.py --tasks HandFlip --steps 30 60 --seeds 3
"""

import dataclasses
import gc
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import rewax
from rewax.physics.numerics import components as cp
from rewax.training.cache import enable_compilation_cache

LEAVES = ("F", "x", "v", "C")
FIRST_STEPS = {"RollingFlat": (0, 10, 20, 40), "HandFlip": (0, 30, 50, 70)}


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this check."""

    tasks: tuple[str, ...] = ("RollingFlat", "HandFlip")
    scale: str = "paper"
    seeds: int = 2
    steps: tuple[int, ...] = ()
    """Control steps before the one that is differentiated; none: those of ``FIRST_STEPS``."""


def gradients(env: Any, state: Any, action: jax.Array) -> dict[str, np.ndarray]:
    """Of the reward of one step, by particles and action."""

    def reward(soft: Any, action: jax.Array) -> jax.Array:
        return env.step(state.replace(physics=state.physics.replace(soft=soft)), action).reward

    by_soft, by_action = jax.jit(jax.grad(reward, argnums=(0, 1)))(state.physics.soft, action)
    found = {name: np.asarray(getattr(by_soft, name), np.float64) for name in LEAVES}
    return {**found, "actions": np.asarray(by_action, np.float64)}


def in_double(tree: Any) -> Any:
    """The same numbers in float64."""
    return jax.tree.map(
        lambda a: jnp.asarray(np.asarray(a), jnp.float64) if getattr(a, "dtype", None) == jnp.float32 else a, tree
    )


def volume_drift(env: Any, state: Any, num_steps: int) -> float:
    """Mean change of det F per substep. In free fall det F stays 1, whatever the mass of a node."""
    det = cp.det(cp.split_matrix(np.asarray(state.physics.soft.F, np.float64)))
    return float(np.mean(det) - 1.0) / (env.num_substeps * num_steps)


def policy(name: str, env: Any, key: jax.Array) -> jax.Array:
    """Random actions that press the pin down, or close the hand."""
    noise = jax.random.uniform(key, env.action_spec.shape, minval=-1.0, maxval=1.0)
    return jnp.clip(noise + (jnp.asarray([0.0, -0.7, 0.0]) if name == "RollingFlat" else 0.3), -1.0, 1.0)


def check(args: Args, name: str) -> None:
    env = rewax.make(name, scale=args.scale)
    step = jax.jit(env.step)
    with jax.enable_x64(True):
        double = in_double(env)
    worst: dict[str, float] = {}
    for seed in range(args.seeds):
        key, state = jax.random.key(seed), env.reset(jax.random.key(1000 + seed))
        steps = args.steps or FIRST_STEPS[name]
        for t in range(max(steps) + 1):
            action = policy(name, env, jax.random.fold_in(key, t))
            if t in steps:
                single = gradients(env, state, action)
                with jax.enable_x64(True):
                    exact = gradients(double, in_double(state), in_double(action))
                report(f"{name} seed {seed} step {t:3d}", single, exact, worst)
            state = step(state, action)
            if name == "HandFlip" and t + 1 == 10:
                print(f"{name} seed {seed}: det F drifts by {volume_drift(env, state, 10):.1e} per substep", flush=True)
    print(f"{name} {args.scale}, largest: " + ", ".join(f"{k} {v:.1e}" for k, v in worst.items()), flush=True)


def report(title: str, single: dict[str, np.ndarray], exact: dict[str, np.ndarray], worst: dict[str, float]) -> None:
    texts = []
    for leaf, g in exact.items():
        size = np.linalg.norm(g)
        if size < 1e-12:  # no contact yet, no gradient
            texts.append(f"{leaf} none")
            continue
        squared = np.sort(((single[leaf] - g) ** 2).reshape(len(g), -1).sum(axis=1))[::-1]
        error = np.sqrt(squared.sum()) / size
        few = 1 + int(np.searchsorted(np.cumsum(squared), 0.9 * squared.sum()))
        texts.append(f"{leaf} {error:.1e}" + ("" if leaf == "actions" else f" ({few})"))
        worst[leaf] = max(worst.get(leaf, 0.0), float(error))
    print(f"{title}: " + ", ".join(texts), flush=True)


def main(args: Args) -> None:
    enable_compilation_cache()
    for name in args.tasks:
        check(args, name)
        jax.clear_caches()
        gc.collect()


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
