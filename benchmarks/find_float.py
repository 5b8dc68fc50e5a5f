"""How fast the encoders of policies learn to find SteerFloat's float, by regression instead of reinforcement learning.

    python benchmarks/find_float.py
    python benchmarks/find_float.py --see depth robot --updates 160 640 2560

A paddle is driven to points around the float, which moves. A network with the encoder and the widths of SAPO's policy
learns where the float is relative to the paddle: from the robot's joints alone, or from depth or 64 visible
points of the float too.
Each update sees as many samples as one of SAPO's, 16 steps of 8 episodes, with SAPO's optimiser. Printed is the root
mean square error along x and z over episodes that were not trained on.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from seeing import inner, seeing, task_of

from rewax.agents.networks import MLP, Encoder
from rewax.agents.normalization import init_statistics, normalize, update_statistics
from rewax.agents.presets import sapo_preset
from rewax.envs.named_sensors import default_camera
from rewax.envs.sensing import Sensing
from rewax.training import enable_compilation_cache

STEPS, EPISODES, TESTED = 60, 288, 32
"""Control steps of an episode; episodes; those among them that are not trained on."""
ONWARD = 8
"""Control steps after which the paddle is driven to another point."""
NEAR = 0.09
"""Largest distance of such a point from the float along each axis [m]."""
UNIT = 0.1
"""Of the outputs [m]."""


class Locator(nn.Module):
    """Observation -> x and z of the float relative to the paddle."""

    config: Any
    see: Sequence[str]

    @nn.compact
    def __call__(self, obs: dict[str, Any]) -> Any:
        c = self.config
        encoder = Encoder(
            c.point_widths, c.point_features, c.vector_features, nn.silu, 1.0, c.picture_widths, c.picture_features,
            self.see,
        )  # fmt: skip
        return nn.Dense(2)(MLP(c.actor_widths, nn.silu, 1.0)(encoder(obs)))


def episodes(env: Any) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Observations and places of the float, leading axes (EPISODES, STEPS)."""
    task = inner(env)

    def drive(key: Any) -> Any:
        def step(carry: Any, given: Any) -> Any:
            state, goal = carry
            i, key = given
            at, turn = jax.random.split(key)
            x = state.physics.soft.x[: task.float_count].mean(0)[jnp.array([0, 2])]
            place = x + jax.random.uniform(at, (2,), minval=-NEAR, maxval=NEAR)
            drawn = jnp.concatenate([place, jax.random.uniform(turn, (1,), minval=-1.0, maxval=1.0)])
            goal = jnp.where(i % ONWARD == 0, drawn, goal)
            action = jnp.clip((goal - state.physics.joint_q) / task.joint_step, -1.0, 1.0)
            return (env.step(state, action), goal), (state.obs, (x - state.physics.joint_q[:2]) / UNIT)

        given = jnp.arange(STEPS), jax.random.split(jax.random.fold_in(key, 1), STEPS)
        return jax.lax.scan(step, (env.reset(key), jnp.zeros(3)), given)[1]

    run = jax.jit(jax.vmap(drive))
    parts = [jax.tree.map(np.asarray, run(keys)) for keys in jax.random.split(jax.random.key(0), (EPISODES // 8, 8))]
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


def rollouts(rng: np.random.Generator, config: Any, count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Indices of episodes and steps: as many as a rollout has, from anywhere in the episodes."""
    shape = (config.num_envs, config.horizon)
    for _ in range(count):
        episode = rng.integers(0, EPISODES - TESTED, (shape[0], 1))
        first = rng.integers(0, STEPS - shape[1] + 1, (shape[0], 1))
        yield tuple(a.reshape(-1) for a in np.broadcast_arrays(episode, first + np.arange(shape[1])))  # pyright: ignore


def errors(config: Any, see: Sequence[str], updates: int, obs: dict[str, Any], wanted: Any) -> np.ndarray:
    """Root mean square errors along x and z after training [m]."""
    network = Locator(config, see)
    predict = jax.vmap(network.apply, (None, 0))
    rate = optax.linear_schedule(config.actor_learning_rate, config.final_learning_rate, updates)
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm),
        optax.adamw(rate, config.adam_b1, config.adam_b2, weight_decay=config.weight_decay),
    )
    params = network.init(jax.random.key(0), jax.tree.map(lambda a: a[0, 0], obs))

    @jax.jit
    def update(params: Any, moments: Any, obs: Any, wanted: Any) -> Any:
        gradient = jax.grad(lambda p: jnp.mean((predict(p, obs) - wanted) ** 2))(params)
        change, moments = optimizer.update(gradient, moments, params)
        return optax.apply_updates(params, change), moments

    moments = optimizer.init(params)
    for at in rollouts(np.random.default_rng(0), config, updates):
        params, moments = update(params, moments, jax.tree.map(lambda a, at=at: a[at], obs), wanted[at])
    seen, truth = jax.tree.map(lambda a: a[-TESTED:].reshape(-1, *a.shape[2:]), (obs, wanted))
    return UNIT * np.sqrt(np.mean((np.asarray(jax.jit(predict)(params, seen)) - truth) ** 2, axis=0))


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the benchmark.

    Attributes:
      see: observations of one run, among ``depth``, ``cloud`` and ``robot``; none: all three columns.
      updates: numbers of updates.
    """

    see: tuple[str, ...] = ()
    updates: tuple[int, ...] = (160, 640)


def main(args: Args) -> None:
    enable_compilation_cache()
    bare, config = task_of("SteerFloat"), sapo_preset("SteerFloat", "small")
    camera = default_camera(bare)
    cloud = seeing(bare, camera, "cloud").sensors["cloud"]
    env = Sensing(env=bare, sensors={"depth": camera, "cloud": cloud})
    obs, wanted = episodes(env)
    obs = {name: obs[name] for name in ("depth", "cloud", "robot")}
    spec = {name: env.observation_spec[name] for name in obs}
    trained = jax.tree.map(lambda a: a[:-TESTED], obs)
    statistics = update_statistics(init_statistics(spec), trained)
    obs = jax.tree.map(np.asarray, normalize(statistics, obs))
    print("| observes | updates | error along x [cm] | along z [cm] |\n|---|---|---|---|")
    for see in (args.see,) if args.see else (("robot",), ("depth", "robot"), ("cloud", "robot")):
        for updates in args.updates:
            x, z = 100 * errors(config, see, updates, obs, wanted)
            print(f"| {', '.join(see)} | {updates} | {x:.1f} | {z:.1f} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
