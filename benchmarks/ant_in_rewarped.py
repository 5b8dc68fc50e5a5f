"""Returns of a policy of AntRun in rewax, and in Rewarped, the simulator of the paper, with both mass matrices.

    python -m venv reference && reference/bin/pip install rewarped torch gym
    python benchmarks/ant_in_rewarped.py --python reference/bin/python

Rewarped computes the ant's mass matrix once per control step and keeps it for all 16 substeps. One attribute of its
environment renews it at every substep; ``stale_mass_matrix`` is the same switch in rewax. Both simulators run on the
CPU. Each draws its own starts, and an episode ends where its environment ends it.
"""

import dataclasses
import subprocess
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import tyro

import rewax
from rewax.statistics import bootstrap_interval
from rewax.training import load_run, make_evaluate
from rewax.training.storage.saved import SavedRun

KEPT, RENEWED = 16, 1
"""Substeps for which Rewarped keeps a mass matrix."""


@dataclasses.dataclass(frozen=True)
class Args:
    """Options.

    Attributes:
      python: of an environment with Rewarped.
      run: directory of a run of AntRun ``paper``; by default the policy that comes with rewax.
      episodes: number of episodes.
      seed: draws starts and actions.
    """

    python: str
    run: str | None = None
    episodes: int = 64
    seed: int = 0


def in_rewax(run: SavedRun, args: Args, *, stale: bool, deterministic: bool) -> np.ndarray:
    """Returns of the episodes, shape (episodes,)."""
    env = rewax.make("AntRun", scale="paper", stale_mass_matrix=stale)
    evaluate = make_evaluate(env, run.agent.policy, args.episodes)
    return np.asarray(evaluate(run.train_state, jax.random.key(args.seed), deterministic=deterministic)["returns"])


def in_rewarped(run: SavedRun, args: Args, *, every: int, deterministic: bool) -> np.ndarray:
    """Returns of the episodes, shape (episodes,)."""
    worker = Path(__file__).with_name("rewarped_worker.py")
    command = [args.python, str(worker), *map(str, (args.episodes, every, args.seed))]
    act, keys = (
        policy(run, args.episodes, deterministic),
        jax.random.split(jax.random.key(args.seed), run.env.episode_length),
    )
    returns, running = np.zeros(args.episodes), np.ones(args.episodes, bool)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None

        def read(*shape: int) -> np.ndarray:
            return np.frombuffer(process.stdout.read(4 * int(np.prod(shape))), np.float32).reshape(shape)

        obs = read(args.episodes, 37)
        for key in keys:
            process.stdin.write(act(obs, key).astype(np.float32).tobytes())
            process.stdin.flush()
            reward, ended = read(2, args.episodes)
            obs = read(args.episodes, 37)
            returns += running * reward
            running &= ended == 0
    return returns


def policy(run: SavedRun, num: int, deterministic: bool) -> Callable[[np.ndarray, jax.Array], np.ndarray]:
    """Actions of all environments from their observations, whose numbers and order are the same in both simulators."""

    @jax.jit
    def actions(obs: jax.Array, key: jax.Array) -> jax.Array:
        def one(obs: jax.Array, key: jax.Array) -> jax.Array:
            return run.agent.policy(run.train_state, {"state": obs}, key, deterministic=deterministic)

        return jax.vmap(one)(obs, jax.random.split(key, num))

    return lambda obs, key: np.asarray(actions(obs, key))


def main(args: Args) -> int:
    run = load_run(args.run) if args.run else rewax.load_policy("AntRun", scale="paper")
    print("| mass matrix | actions | rewax | Rewarped |\n|---|---|---|---|")
    for name, every in (("renewed at every substep", RENEWED), ("kept for a control step", KEPT)):
        for deterministic in (False, True):
            ours = in_rewax(run, args, stale=every == KEPT, deterministic=deterministic)
            theirs = in_rewarped(run, args, every=every, deterministic=deterministic)
            how = "deterministic" if deterministic else "sampled"
            print(f"| {name} | {how} | {cell(ours)} | {cell(theirs)} |", flush=True)
    return 0


def cell(returns: np.ndarray) -> str:
    """Mean and 95 % bootstrap interval over the episodes."""
    low, high = bootstrap_interval(returns)
    return f"{returns.mean():.0f} [{low:.0f}, {high:.0f}]"


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Args, description=__doc__)))
