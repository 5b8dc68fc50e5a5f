"""Trains tiny agents, by their names as arguments, on one and on several devices of a CPU.

A process of its own, for JAX counts devices once: as many as ``DEVICES`` says.
"""

import dataclasses
import os
import sys
import tempfile
from pathlib import Path

import jax

if "DEVICES" in os.environ:
    jax.config.update("jax_num_cpu_devices", int(os.environ["DEVICES"]))
sys.path.insert(0, str(Path(__file__).resolve().parent.parent.parent))

import numpy as np
from rich.console import Console
from toys import PointMass, point_mass

from rewax import struct
from rewax.agents.registry import algorithm
from rewax.training.config import TrainConfig
from rewax.training.loop.devices import on_one_device, placement
from rewax.training.loop.seeds import train_seeds
from rewax.training.loop.train import train

SIZES = {
    "num_envs": 8,
    "horizon": 4,
    "num_iterations": 4,
    "actor_widths": (4,),
    "critic_widths": (4,),
    "vector_features": 4,
}
QUICK = {
    "num_eval_episodes": 2,
    "plots": False,
    "baselines": False,
    "tensorboard": False,
    "eval_every": 0,
    "checkpoint_every": 2,
}
OWN = {
    "ppo": {"minibatches": 2, "epochs": 2},
    "sac": {"replay_size": 64, "batch_size": 8, "updates": 2, "warmup_steps": 4},
    "ahac": {"min_horizon": 2, "initial_horizon": 4},
}


def make(name):
    env, known = point_mass(), algorithm(name)
    names = {field.name for field in dataclasses.fields(known.config_type)}
    sizes = {key: value for key, value in {**SIZES, **OWN.get(name, {})}.items() if key in names}
    if name == "trajopt":
        sizes.pop("horizon")
    return env, known.make(env, known.config_type(**sizes))


def run(name, num_devices, folder, *, resume=False, iterations=4):
    env, agent = make(name)
    config = TrainConfig(num_iterations=iterations, run_dir=folder, devices=num_devices, resume=resume, **QUICK)
    return train(agent, env, config, console=Console(quiet=True)).train_state


@struct.dataclass
class WithNothing(PointMass):
    """A point mass whose state has an array without numbers, as that of robots without activations."""

    def reset(self, key):
        return PointMass.reset(self, key).replace(delayed=jax.numpy.zeros(0))


def run_seeds(num_devices, folder, *, count=4):
    """Four seeds, of which each device computes as many."""
    _, agent = make("sapo")
    env = WithNothing(gain=jax.numpy.float32(0.5))
    agent = algorithm("sapo").make(env, agent.config)
    config = TrainConfig(num_iterations=3, run_dir="a", devices=num_devices, **QUICK)
    configs = [dataclasses.replace(config, seed=seed, run_dir=f"{folder}/{seed}") for seed in range(count)]
    with open(f"{folder}.txt", "w") as file:
        results = train_seeds(agent, env, configs, console=Console(file=file, width=200))
    said = Path(f"{folder}.txt").read_text()
    assert (", seeds on 4 devices" in said) == (num_devices == 0), said
    return [(result.train_state, result.evaluation["sampled_mean"]) for result in results]


def numbers(state):
    leaves = [leaf for leaf in jax.tree.leaves(state) if jax.numpy.issubdtype(leaf.dtype, jax.numpy.floating)]
    return [np.asarray(leaf) for leaf in leaves]


def compare(a, b):
    for x, y in zip(numbers(a), numbers(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=2e-3, atol=2e-4)


def check_program(agent):
    """No device gets the environments of another, nor their steps in a replay buffer."""
    where = placement(8, 2)
    state = where.place(jax.jit(agent.init)(jax.random.key(0)))
    program = where.lowered(agent.train_step, state).compile().as_text()
    assert " all-reduce(" in program and " all-gather(" not in program
    if agent.name == "sac":
        sizes = [shard.data.shape[:2] for shard in state.replay.steps.action.addressable_shards]
        assert sizes == [(state.replay.capacity, 4)] * 2
        one = on_one_device(state)
        assert all(len(leaf.devices()) == 1 for leaf in jax.tree.leaves(one))
        assert len(one.environments.episode_return) == 8 and one.replay.steps.action.shape[:2] == sizes[0]


def main():
    with tempfile.TemporaryDirectory() as folder:
        for name in sys.argv[1:]:
            one = run(name, 1, f"{folder}/{name}-1")
            for count in (2, 8):
                several = run(name, count, f"{folder}/{name}-{count}")
                assert len(several.environments.episode_return.devices()) == count, name
                compare(one, several)
        for (one, earns), (several, earns_too) in zip(
            run_seeds(1, f"{folder}/seeds-1"), run_seeds(0, f"{folder}/seeds-4"), strict=True
        ):
            compare(one, several)
            np.testing.assert_allclose(earns, earns_too, rtol=1e-3)
        run("sapo", 8, f"{folder}/resumed", iterations=2)
        compare(run("sapo", 1, f"{folder}/resumed", resume=True), run("sapo", 1, f"{folder}/sapo-1b"))
    for name in ("sapo", "sac"):
        check_program(make(name)[1])
    print("the same on one and on several devices")


if __name__ == "__main__":
    main()
