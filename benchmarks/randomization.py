"""Does domain randomisation help? SAPO on RollingFlat `small`, dough of one stiffness or of one drawn per episode.

Trains one policy on dough of the task's stiffness and one on dough whose stiffness, Young's modulus and yield stress
alike, is drawn log-uniformly between 0.5 and 2 times at each reset; then evaluates both on the whole range, from the
same initial states.

    for s in 0 1 2; do python benchmarks/randomization.py --seed $s --out randomization-$s.json; done
    python benchmarks/randomization.py --table randomization-*.json
"""

import argparse
import dataclasses
import functools
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import rewax
from rewax.agents.presets import sapo_preset
from rewax.agents.sapo import make_sapo
from rewax.training import enable_compilation_cache

FACTORS = (0.5, 0.707, 1.0, 1.414, 2.0)
NUM_SUBSTEPS = 15  # shorter substeps than the task's: dough of twice the stiffness is stable with them


def environment(scaled: str):
    """RollingFlat `small`, and a function that makes its dough stiffer by a factor."""
    env = rewax.make("RollingFlat", scale="small", num_substeps=NUM_SUBSTEPS)

    def stiffer(env, factor):
        for path in scaled.split(","):
            value = functools.reduce(getattr, path.split("."), env.scene.material)
            env = rewax.replace_leaf(env, f"scene.material.{path}", factor * value)
        return env

    return env, stiffer


def train(env, randomize, seed: int, num_iterations: int, num_envs: int):
    """A trained state, its agent, and the seconds it took."""
    preset = sapo_preset("RollingFlat", "small")
    config = dataclasses.replace(preset, num_iterations=num_iterations, num_envs=num_envs)
    agent = make_sapo(env, config, randomize=randomize)
    state, began = agent.init(jax.random.key(seed)), time.perf_counter()
    for _ in range(num_iterations):
        state, metrics = agent.train_step(state)
    jax.block_until_ready(metrics)
    return agent, state, time.perf_counter() - began


def evaluate(agent, state, env, stiffer, num_episodes: int) -> list[float]:
    """Mean return with deterministic actions at each factor."""
    keys = jax.random.split(jax.random.key(1234), num_episodes)

    @jax.jit
    def mean_return(factor):
        def episode(key):
            varied = stiffer(env, factor)

            def step(carry, _):
                s, total = carry
                s = varied.step(s, agent.policy(state, s.obs, key, deterministic=True))
                return (s, total + s.reward), None

            start = (varied.reset(key), jnp.zeros(()))
            return jax.lax.scan(step, start, None, length=env.episode_length)[0][1]

        return jax.vmap(episode)(keys).mean()

    return [float(mean_return(jnp.float32(factor))) for factor in FACTORS]


def table(paths: list[str]) -> str:
    """Markdown: return over stiffness, one row per policy."""
    runs = [json.loads(Path(path).read_text()) for path in paths]
    lines = ["| trained on | seed | " + " | ".join(f"{f:g} x" for f in FACTORS) + " | mean |"]
    lines.append("|" + "---|" * (len(FACTORS) + 3))
    for name in ("one stiffness", "drawn stiffness"):
        for run in sorted(runs, key=lambda run: run["seed"]):
            row = run[name]
            cells = " | ".join(f"{value:.1f}" for value in row)
            lines.append(f"| {name} | {run['seed']} | {cells} | {np.mean(row):.2f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--iterations", type=int, default=120)
    parser.add_argument("--envs", type=int, default=32)
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument(
        "--scaled",
        default="elasticity.youngs_modulus,plasticity.yield_stress",
        help="parameters of the dough that are scaled together",
    )
    parser.add_argument("--out", default="randomization.json")
    parser.add_argument("--table", nargs="+", help="print the table of these results and stop")
    args = parser.parse_args()
    if args.table:
        print(table(args.table))
        return
    enable_compilation_cache()
    env, stiffer = environment(args.scaled)

    def draw(key, env):
        return stiffer(env, 2.0 ** jax.random.uniform(key, minval=-1.0, maxval=1.0))

    result = {"factors": FACTORS, **{name: getattr(args, name) for name in ("seed", "scaled", "iterations", "envs")}}
    for name, hook in (("one stiffness", None), ("drawn stiffness", draw)):
        agent, state, seconds = train(env, hook, args.seed, args.iterations, args.envs)
        result[name] = evaluate(agent, state, env, stiffer, args.episodes)
        result[f"{name}, seconds"] = seconds
        print(name, args.seed, [round(value, 2) for value in result[name]], f"{seconds:.0f} s", flush=True)
    Path(args.out).write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
