"""How far float32 is off: gradients of one control step beside float64, and volume that dough in free fall loses.

For each seed the task runs for some steps, so that tools touch the dough and it yields. From each state on the way one
step is taken in float32 and, from the same numbers, in float64. Printed is |g32 - g64| / |g64| of the gradients of the
reward, and of a random function of the state after it, by each leaf of the state and by the actions. In brackets stands
how far float64 itself moves if positions, velocities and deformations are moved by at most four units in float32's last
place, as rounding does in 40 substeps, the largest of three draws: contact and yield set in at a step, and a state
within rounding of one has no gradient that float32 could know.

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
from rewax.training import enable_compilation_cache

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


@jax.jit
def gradients(env: Any, state: Any, action: jax.Array, weights: Any) -> dict[str, jax.Array]:
    """Of the reward of one step and of the weighted sum of the state after it, (2, ...) each."""

    def objectives(soft: Any, action: jax.Array) -> jax.Array:
        new = env.step(state.replace(physics=state.physics.replace(soft=soft)), action)
        weighted = jax.tree.map(lambda w, a: jnp.sum(w * a), weights, new.physics.soft)
        return jnp.stack([new.reward, sum(jax.tree.leaves(weighted))])

    by_soft, by_action = jax.jacrev(objectives, argnums=(0, 1))(state.physics.soft, action)
    return {**{name: getattr(by_soft, name) for name in LEAVES}, "actions": by_action}


def in_numpy(found: dict[str, jax.Array]) -> dict[str, np.ndarray]:
    return {name: np.asarray(a, np.float64) for name, a in found.items()}


def random_weights(soft: Any, seed: int) -> Any:
    """Of x, v, C and F, so that all count alike; where C is rounding, as in free fall, it does not count more."""
    rng = np.random.default_rng(seed)

    def one(a: jax.Array) -> jax.Array:
        size = max(float(np.sqrt(np.mean(np.square(a)))), 0.1)
        return jnp.asarray(rng.standard_normal(a.shape) / size, a.dtype)

    return jax.tree.map(one, soft)


def in_double(tree: Any) -> Any:
    """The same numbers in float64."""
    return jax.tree.map(
        lambda a: jnp.asarray(np.asarray(a), jnp.float64) if getattr(a, "dtype", None) == jnp.float32 else a, tree
    )


def moved_by_rounding(state: Any, seed: int) -> Any:
    """A state in float64 with its particles moved by up to four units in the last place of float32."""
    rng = np.random.default_rng(seed)
    size = 4.0 * float(jnp.finfo(jnp.float32).eps)
    soft = jax.tree.map(lambda a: a * (1.0 + size * jnp.asarray(rng.uniform(-1.0, 1.0, a.shape))), state.physics.soft)
    return state.replace(physics=state.physics.replace(soft=soft))


def volume_drift(env: Any, state: Any, num_steps: int) -> float:
    """Mean change of det F per substep. In free fall det F stays 1, whatever the mass of a node."""
    det = cp.det(cp.split_matrix(np.asarray(state.physics.soft.F, np.float64)))
    return float(np.mean(det) - 1.0) / (env.num_substeps * num_steps)


def policy(name: str, env: Any, key: jax.Array) -> jax.Array:
    """Random actions that press the pin down, or close the hand."""
    noise = jax.random.uniform(key, env.action_spec.shape, minval=-1.0, maxval=1.0)
    return jnp.clip(noise + (jnp.asarray([0.0, -0.7, 0.0]) if name == "RollingFlat" else 0.3), -0.99, 0.99)


def check(args: Args, name: str) -> None:
    env = rewax.make(name, scale=args.scale)
    step = jax.jit(env.step)
    with jax.enable_x64(True):
        double = in_double(env)
    for seed in range(args.seeds):
        key, state = jax.random.key(seed), env.reset(jax.random.key(1000 + seed))
        steps = args.steps or FIRST_STEPS[name]
        for t in range(max(steps) + 1):
            action = policy(name, env, jax.random.fold_in(key, t))
            if t in steps:
                weights = random_weights(step(state, action).physics.soft, t)
                single = in_numpy(gradients(env, state, action, weights))
                with jax.enable_x64(True):
                    same, *others = in_double((state, action, weights))
                    exact = in_numpy(gradients(double, same, *others))
                    moved = [in_numpy(gradients(double, moved_by_rounding(same, n), *others)) for n in range(3)]
                for n, of in enumerate(("reward", "state")):
                    title = f"{name} seed {seed} step {t:3d} {of}"
                    report(title, *({k: g[n] for k, g in each.items()} for each in (single, exact, *moved)))
            state = step(state, action)
            if name == "HandFlip" and t + 1 == 10:
                print(f"{name} seed {seed}: det F drifts by {volume_drift(env, state, 10):.1e} per substep", flush=True)


def report(title: str, single: Any, exact: Any, *moved: Any) -> None:
    texts = []
    for leaf in (*LEAVES, "actions"):
        size = np.linalg.norm(exact[leaf])
        if size < 1e-12:  # no contact yet, no gradient
            texts.append(f"{leaf} none")
            continue
        error, *itself = (np.linalg.norm(one[leaf] - exact[leaf]) / size for one in (single, *moved))
        texts.append(f"{leaf} {error:.1e} ({max(itself):.1e})")
    print(f"{title}: " + ", ".join(texts), flush=True)


def main(args: Args) -> None:
    enable_compilation_cache()
    for name in args.tasks:
        check(args, name)
        jax.clear_caches()
        gc.collect()


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
