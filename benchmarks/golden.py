"""Values of every task, to the bit: resets, steps, gradients and train steps of SAPO, one seed, float32.

Run it in two checkouts on one machine, then compare: what differs is listed by task and part.

    PYTHONPATH=../other python benchmarks/golden.py --out before.npz
    PYTHONPATH=. python benchmarks/golden.py --out after.npz
    python benchmarks/golden.py --compare before.npz after.npz

With ``--agents``: every algorithm on the tests' point mass instead, which needs their folder: ``PYTHONPATH=.:tests``.
"""

import argparse
import collections
import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

NUM_STEPS, NUM_ITERATIONS = 4, 2


def arrays(tree: Any) -> dict[str, np.ndarray]:
    """Leaves by name; keys as their data."""

    def data(a: Any) -> np.ndarray:
        return np.asarray(jax.random.key_data(a) if jnp.issubdtype(a.dtype, jax.dtypes.prng_key) else a)

    named = jax.tree.leaves_with_path(tree)
    return {jax.tree_util.keystr(path): data(a) for path, a in named if a.dtype != jax.dtypes.float0}


def values_of(name: str) -> dict[str, Any]:
    """Trees of values of one task at scale ``small``."""
    from rewax.agents.presets import sapo_preset
    from rewax.agents.sapo import make_sapo
    from rewax.envs import make

    env = make(name, scale="small")
    state = jax.jit(lambda env, key: env.reset(key))(env, jax.random.key(3))
    shape = (NUM_STEPS, *env.action_spec.shape)
    actions = jax.random.uniform(jax.random.key(5), shape, minval=-1.0, maxval=1.0)

    def total(actions: Any, env: Any, state: Any) -> Any:
        def step(state: Any, action: Any) -> Any:
            state = env.step(state, action)
            return state, state.reward

        end, rewards = jax.lax.scan(step, state, actions)
        return rewards.sum(), (end, rewards)

    gradient = jax.jit(jax.value_and_grad(total, argnums=(0, 1), has_aux=True, allow_int=True))
    (_, steps), (by_action, by_env) = gradient(actions, env, state)
    agent = make_sapo(env, dataclasses.replace(sapo_preset(name, "small"), num_envs=4, horizon=8))
    parts = {"reset": state, "steps": steps, "gradient by actions": by_action, "gradient by leaves": by_env}
    return {**parts, **trained(agent)}


def values_of_agent(name: str) -> dict[str, Any]:
    """Trees of values of one case of ``tests/agent_cases.py``."""
    from agent_cases import agent  # type: ignore[import-not-found]

    return trained(agent(name))


def trained(agent: Any) -> dict[str, Any]:
    """The first state of a run, and the last with its metrics."""
    first, metrics = agent.init(jax.random.key(0)), None
    state = jax.tree.map(jnp.copy, first)  # SAC consumes its input
    for _ in range(NUM_ITERATIONS):
        state, metrics = agent.train_step(state)
    return {"init": first, "train_step": (state, metrics)}


def compare(before: dict[str, np.ndarray], after: dict[str, np.ndarray]) -> list[str]:
    """A line for each task and part: how many arrays are equal to the bit, and the largest relative difference.

    Arrays of different types are not equal, and arrays that only one file has are named.
    """
    parts = collections.defaultdict(list)
    for name in sorted(before.keys() | after.keys()):
        task, part, leaf = name.split("|", 2)
        parts[task, part].append((leaf, before.get(name), after.get(name)))
    lines = []
    for (task, part), leaves in parts.items():
        both = [(leaf, a, b) for leaf, a, b in leaves if a is not None and b is not None]
        different = [(leaf, a, b) for leaf, a, b in both if not _equal(a, b)]
        line = f"{task:16s} {part:20s} {len(both) - len(different)} of {len(leaves)} equal"
        if different:
            worst = max(_difference(a, b) for _, a, b in different)
            line += f", largest difference {worst:.1e}: " + ", ".join(_named(*row) for row in different[:4])
        for what, at in (("before", 2), ("after", 1)):
            alone = [row[0] for row in leaves if row[at] is None]
            line += f", only {what}: {', '.join(alone)}" if alone else ""
        lines.append(line)
    return lines


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def _named(leaf: str, a: np.ndarray, b: np.ndarray) -> str:
    return leaf if a.dtype == b.dtype else f"{leaf} ({a.dtype}, now {b.dtype})"


def _difference(a: np.ndarray, b: np.ndarray) -> float:
    """The largest, over the largest finite number of ``a``; infinite for other shapes, NaN or infinity for a number."""
    if a.shape != b.shape:
        return np.inf
    a, b = a.astype(float), b.astype(float)
    with np.errstate(invalid="ignore"):
        apart = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.abs(a - b))
    apart = np.where(np.isnan(apart), np.inf, apart)
    largest = np.max(np.abs(a), where=np.isfinite(a), initial=1e-30)
    return float(np.max(apart, initial=0.0) / largest)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", help="names; every registered one by default")
    parser.add_argument("--agents", action="store_true", help="algorithms instead of tasks")
    parser.add_argument("--out", default="golden.npz")
    parser.add_argument("--compare", nargs=2, metavar=("BEFORE", "AFTER"))
    args = parser.parse_args()
    if args.compare:
        print("\n".join(compare(*(dict(np.load(path)) for path in args.compare))))
        return
    if args.agents:
        from agent_cases import CASES as known  # type: ignore[import-not-found]
    else:
        from rewax.envs import list_envs

        known = list_envs()
    found = {}
    for task in args.tasks or known:
        for part, tree in (values_of_agent if args.agents else values_of)(task).items():
            found |= {f"{task}|{part}|{leaf}": value for leaf, value in arrays(tree).items()}
        print(task, flush=True)
        np.savez(Path(args.out), **found)


if __name__ == "__main__":
    main()
