"""How many nodes RollingFlat needs, how far its dough moves and how far it gets, over many kinds of actions.

A scene's ``max_active_nodes`` must never change what happens. This benchmark runs episodes with a list that is longer
than the scene's own and prints, for each kind of actions, the most nodes that a list had to hold, the farthest that a
particle moved while a list served, in cells (it must stay below the scene's reach), and the box in which all particles
were. The kinds:

    held     each of the 26 actions of -1, 0 and 1 except zero, all through the episode
    bang     each component is -1 or 1, held for 3 to 70 steps
    smooth   filtered noise, clipped
    random   uniform in [-1, 1]
    rolling  press and sweep over the dough

    python benchmarks/active_nodes.py --scale small
    python benchmarks/active_nodes.py --scale paper --kinds held --steps 120
"""

import dataclasses
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import rewax
from rewax.physics import mpm
from rewax.status import describe
from rewax.training import enable_compilation_cache


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    scale: str = "small"
    kinds: tuple[str, ...] = ("held", "bang", "smooth", "random", "rolling")
    num_episodes: int = 26
    """Episodes of each kind; held actions come in their order."""
    steps: int = 0
    """Control steps of an episode; 0: the environment's own number."""
    seed: int = 0
    list_size: int = 0
    """Nodes that a list holds during the measurement; 0: twice as many as the scene's own."""


def actions_of(kind: str, num: int, steps: int, rng: np.random.Generator) -> np.ndarray:
    """Actions, shape (num, steps, 3)."""
    if kind == "held":
        corners = [c for c in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(c)]
        return np.stack([np.tile(corners[i % len(corners)], (steps, 1)) for i in range(num)])
    if kind == "bang":
        return np.stack([[_bang(steps, rng) for _ in range(3)] for _ in range(num)]).transpose(0, 2, 1)
    if kind == "random":
        return rng.uniform(-1.0, 1.0, (num, steps, 3))
    actions = np.zeros((num, steps, 3))
    if kind == "smooth":
        value = np.zeros((num, 3))
        for t in range(steps):
            value = 0.9 * value + 0.3 * rng.normal(size=(num, 3))
            actions[:, t] = value.clip(-1.0, 1.0)
        return actions
    if kind != "rolling":
        raise ValueError(f"kinds has {kind!r}: give some of held, bang, smooth, random, rolling")
    half_periods = rng.integers(5, 40, num)
    actions[..., 0] = np.sign(np.sin((np.arange(steps) + 0.5) * np.pi / half_periods[:, None]))
    actions[..., 1] = -rng.uniform(0.1, 1.0, (num, 1))
    return actions


def _bang(steps: int, rng: np.random.Generator) -> np.ndarray:
    signs = [np.full(rng.integers(3, 70), rng.choice([-1.0, 1.0])) for _ in range(steps)]
    return np.concatenate(signs)[:steps]


def measure(env: Any, actions: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """What each control step of each episode needed, arrays (steps, num_episodes, ...)."""
    scene = env.scene
    every = env.list_every or env.num_substeps
    parts = env.num_substeps // every

    def step(state: rewax.State, action: jax.Array) -> tuple[rewax.State, dict[str, jax.Array]]:
        """The control step in the parts that each have a list; the pin's motion is spread evenly over them."""
        part = env.replace(num_substeps=every, joint_step=env.joint_step / parts)

        def one(state: rewax.State, _: None) -> tuple[rewax.State, tuple[jax.Array, ...]]:
            before = state.physics.soft.x
            state = part.step(state, action)
            after = state.physics.soft.x
            far = jnp.abs(after - before).max() / scene.grid.spacing
            count = mpm.count_nodes(scene.grid, before, reach=scene.reach)
            return state, (count, far, after.min(0), after.max(0), state.status)

        state, (count, far, low, high, status) = jax.lax.scan(one, state, None, length=parts)
        bits = jax.lax.reduce(status, np.int32(0), jax.lax.bitwise_or, (0,))
        needed = {"count": count.max(), "far": far.max(), "low": low.min(0), "high": high.max(0), "status": bits}
        return state, needed

    keys = jax.random.split(jax.random.key(seed), len(actions))
    state = jax.jit(jax.vmap(env.reset))(keys)
    run = jax.jit(jax.vmap(step))
    rows = []
    for t in range(actions.shape[1]):
        state, row = run(state, jnp.asarray(actions[:, t], jnp.float32))
        rows.append(jax.tree.map(np.asarray, row))
    return jax.tree.map(lambda *a: np.stack(a), *rows)


def main(args: Args) -> None:
    enable_compilation_cache()
    env: Any = rewax.make("RollingFlat", scale=args.scale)
    size = args.list_size or 2 * env.scene.max_active_nodes
    print(f"RollingFlat {args.scale}: list of {env.scene.max_active_nodes} nodes, reach {env.scene.reach} cells")
    env = env.replace(scene=env.scene.replace(max_active_nodes=size))
    for i, kind in enumerate(args.kinds):
        rng = np.random.default_rng(args.seed + i)
        actions = actions_of(kind, args.num_episodes, args.steps or env.episode_length, rng)
        found = measure(env, actions, args.seed + i)
        low, high = found["low"].min((0, 1)).round(3), found["high"].max((0, 1)).round(3)
        print(
            f"  {kind:8s} most nodes {found['count'].max():6d}   farthest {found['far'].max():.2f} cells   "
            f"from {low} to {high} m   status {describe(int(np.bitwise_or.reduce(found['status'], axis=None)))}",
            flush=True,
        )


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
