"""Returns of a policy of AntRun in rewax, and in Rewarped, the simulator of the paper, with both mass matrices.

    python -m venv reference && reference/bin/pip install rewarped==1.3.3 torch gym
    python benchmarks/ant_in_rewarped.py --python reference/bin/python

Rewarped computes the ant's mass matrix once per control step and keeps it for all 16 substeps. One attribute of its
environment renews it at every substep; ``stale_mass_matrix`` is the same switch in rewax. Both simulators run on the
CPU. Each draws its own starts, and an episode ends where its environment ends it.
"""

import dataclasses
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import rewax
from rewax.envs.kit.rigid_task import RigidPhysics
from rewax.physics import rigid
from rewax.physics.numerics import quaternion_to_matrix
from rewax.statistics import bootstrap_interval
from rewax.training import load_run, make_evaluate
from rewax.training.storage.saved import SavedRun

KEPT, RENEWED = 16, 1
"""Substeps for which Rewarped keeps a mass matrix."""
COMPARED = 50
"""One of so many control steps is computed in both simulators."""
VELOCITY = slice(5, 8)
"""Of the torso, in the observation [m/s]."""


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


class Seen(NamedTuple):
    """Control steps in Rewarped: observation, action, next observation, one row each."""

    obs: np.ndarray
    action: np.ndarray
    after: np.ndarray


def in_rewarped(run: SavedRun, args: Args, *, every: int, deterministic: bool) -> tuple[np.ndarray, Seen]:
    """Returns of the episodes, shape (episodes,), and some of their control steps."""
    worker, num = Path(__file__).with_name("rewarped_worker.py"), args.episodes
    command = [args.python, str(worker), *map(str, (num, every, args.seed))]
    act, keys = policy(run, num, deterministic), jax.random.split(jax.random.key(args.seed), run.env.episode_length)
    returns, running, seen = np.zeros(num), np.ones(num, bool), []
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
        stream = process.stdout

        def read(*shape: int) -> np.ndarray:
            return np.frombuffer(stream.read(4 * int(np.prod(shape))), np.float32).reshape(shape)

        obs = read(num, 37)
        for step, key in enumerate(keys):
            action = act(obs, key).astype(np.float32)
            process.stdin.write(action.tobytes())
            process.stdin.flush()
            reward, ended = read(2, num)
            before, obs = obs, read(num, 37)
            returns += running * reward
            running &= ended == 0
            if step % COMPARED == COMPARED - 1:
                seen.append(Seen(*(array[running] for array in (before, action, obs))))
    return returns, Seen(*map(np.concatenate, zip(*seen, strict=True)))


def differences(seen: Seen, *, stale: bool) -> np.ndarray:
    """Distance of the torso's velocity in rewax from that in Rewarped after one control step [m/s], one a step."""
    env = rewax.make("AntRun", scale="paper", stale_mass_matrix=stale)

    def after(obs: jax.Array, action: jax.Array) -> jax.Array:
        height, orientation, velocity, spin, joints, rates, _, last = jnp.split(obs, [1, 5, 8, 11, 19, 27, 29])
        orientation = orientation[jnp.array([3, 0, 1, 2])]
        spin = quaternion_to_matrix(orientation).T @ spin  # a free joint of MuJoCo turns in the frame of its body
        qpos = jnp.concatenate([jnp.zeros(1), height, jnp.zeros(1), orientation, joints])
        bodies = rigid.initial_state(env.model, qpos, jnp.concatenate([velocity, spin, 10.0 * rates]))
        physics, _ = env.advance(RigidPhysics(rigid=bodies, action=last), action)
        return env.observe(physics)["state"]

    found = np.asarray(jax.jit(jax.vmap(after))(jnp.asarray(seen.obs), jnp.asarray(np.clip(seen.action, -1, 1))))
    return np.linalg.norm(found[:, VELOCITY] - seen.after[:, VELOCITY], axis=1)


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
    columns = "mass matrix | actions | rewax | Rewarped | median difference [m/s] | largest [m/s] | steps | speed [m/s]"
    print(f"| {columns} |")
    print("|---|---|---|---|---|---|---|---|")
    for name, every in (("renewed at every substep", RENEWED), ("kept for a control step", KEPT)):
        for how in ("sampled", "deterministic"):
            ours = in_rewax(run, args, stale=every == KEPT, deterministic=how == "deterministic")
            theirs, seen = in_rewarped(run, args, every=every, deterministic=how == "deterministic")
            off = differences(seen, stale=every == KEPT)
            step = f"{np.median(off):.3g} | {off.max():.3g} | {len(off)}"
            speed = f"{np.linalg.norm(seen.after[:, VELOCITY], axis=1).mean():.3g}"
            print(f"| {name} | {how} | {cell(ours)} | {cell(theirs)} | {step} | {speed} |", flush=True)
    return 0


def cell(returns: np.ndarray) -> str:
    """Mean and 95 % bootstrap interval over the episodes."""
    low, high = bootstrap_interval(returns)
    return f"{returns.mean():.0f} [{low:.0f}, {high:.0f}]"


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Args, description=__doc__)))
