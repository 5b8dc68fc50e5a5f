"""How saturated policies begin: the slope 1 - a^2 that the squashing leaves of a gradient, before any training.

python benchmarks/initial_policy.py --tasks RollingFlat --algorithms sapo shac
"""

import argparse
import dataclasses

import jax
import jax.numpy as jnp

from rewax.agents.actor_critic import make_actor
from rewax.agents.normalization import init_statistics
from rewax.agents.registry import algorithm
from rewax.envs import make

SEEDS, STARTS = 32, 8


def modes(task: str, config) -> jax.Array:
    """Modes of new policies at starts of a task, shape (SEEDS, STARTS, action_size)."""
    env = make(task, scale="small")
    starts = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), STARTS)).obs
    actor, statistics = make_actor(env, config), init_statistics(env.observation_spec)
    first = jax.tree.map(lambda a: a[0], starts)

    def of_seed(key):
        params = actor.network.init(key, first)
        return jax.vmap(lambda obs: actor.action_distribution(params, statistics, obs).mode())(starts)

    return jax.jit(jax.vmap(of_seed))(jax.random.split(jax.random.key(1), SEEDS))


def actors(task: str, name: str) -> list:
    """Configurations whose new policies differ: the preset, the defaults of the actor, and these with gain 1."""
    known = algorithm(name)
    preset, default = known.preset(task, "small"), known.config_type()
    defaults = dataclasses.replace(preset, activation=default.activation, initial_gain=default.initial_gain)
    return list(dict.fromkeys([preset, defaults, dataclasses.replace(defaults, initial_gain=1.0)]))


def main() -> None:
    """One line for each task, algorithm and configuration of its actor."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=["RollingFlat"])
    parser.add_argument("--algorithms", nargs="+", default=["sapo", "shac"])
    args = parser.parse_args()
    print("task algorithm activation gain  |mode| > 0.9  mean slope  least mean slope of a seed")
    for task in args.tasks:
        for name in args.algorithms:
            for config in actors(task, name):
                mode = modes(task, config)
                slope = 1.0 - mode**2
                saturated, least = jnp.mean(jnp.abs(mode) > 0.9), slope.mean(axis=(1, 2)).min()
                kind = f"{config.activation} {config.initial_gain:.2f}"
                print(f"{task} {name} {kind}  {saturated:.2f}  {slope.mean():.2f}  {least:.2f}", flush=True)


if __name__ == "__main__":
    main()
