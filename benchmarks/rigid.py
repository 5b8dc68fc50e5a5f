"""Articulated rigid bodies: substeps per second, compile time and memory, forward and with the gradient.

A rollout of 32 substeps in 64 environments, random controls; the gradient is that of a random combination of the last
positions by first positions, velocities and controls. Per second of wall time, and of CPU time (of one core, that is).

    python benchmarks/rigid.py
    python benchmarks/rigid.py --models ant hopper --law penalty
"""

import dataclasses
import tempfile
import time
from typing import Literal

import jax
import jax.numpy as jnp
import tyro

from rewax.envs.rigid_task import load_asset
from rewax.physics import rigid
from rewax.physics.rigid_penalty import Penalty

MODELS = {"ant": "ant.xml", "hopper": "hopper.xml", "hand": "allegro.xml", "humanoid": "humanoid.xml"}


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    models: tuple[str, ...] = tuple(MODELS)
    law: Literal["constraints", "penalty", "both"] = "both"
    num_envs: int = 64
    num_steps: int = 32
    repeats: int = 10


def main(args: Args) -> None:
    laws = ("constraints", "penalty") if args.law == "both" else (args.law,)
    columns = ("model", "law", "what", "trace", "compile cold", "compile warm", "steps/s", "steps/CPU-s", "memory")
    print("| " + " | ".join(columns) + " |")
    print("|" + "---|" * len(columns))
    with tempfile.TemporaryDirectory() as cache:
        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        for name in args.models:
            for law in laws:
                penalty = Penalty(stiffness=2e4, damping=500.0, friction_damping=500.0) if law == "penalty" else None
                model = load_asset(MODELS[name], dt=1.0 / (960 if penalty else 240), penalty=penalty)
                for what in ("forward", "gradient"):
                    print(
                        f"| {name} | {law} | {what} | {measure(args, model, gradient=what == 'gradient')} |", flush=True
                    )


def measure(args: Args, model: rigid.RigidModel, *, gradient: bool) -> str:
    """A row of the table."""
    keys = jax.random.split(jax.random.key(0), 3)
    weights = jax.random.normal(keys[0], (model.num_positions,))

    def outcome(qpos, qvel, ctrl):
        state = rigid.initial_state(model, qpos, qvel)
        state = jax.lax.scan(lambda s, c: (rigid.step(model, s, c), None), state, ctrl)[0]
        return state.qpos @ weights

    function = jax.value_and_grad(outcome, argnums=(0, 1, 2)) if gradient else outcome
    inputs = (
        jnp.tile(model.home, (args.num_envs, 1)),
        0.1 * jax.random.normal(keys[1], (args.num_envs, model.num_dofs)),
        0.3 * jax.random.normal(keys[2], (args.num_envs, args.num_steps, model.num_actuators)),
    )
    begin = time.process_time()
    lowered = jax.jit(jax.vmap(function)).lower(*inputs)
    trace = time.process_time() - begin
    begin = time.process_time()
    compiled = lowered.compile()
    cold = time.process_time() - begin
    begin = time.process_time()
    jax.jit(jax.vmap(function)).lower(*inputs).compile()
    warm = time.process_time() - begin
    wall, cpu = [], []
    for _ in range(args.repeats):
        start, begin = time.perf_counter(), time.process_time()
        jax.block_until_ready(compiled(*inputs))
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - begin)
    steps = args.num_envs * args.num_steps
    memory = compiled.memory_analysis().temp_size_in_bytes
    seconds = f"{trace:.1f} | {cold:.1f} | {warm:.1f}"
    return f"{seconds} | {steps / min(wall):,.0f} | {steps / min(cpu):,.0f} | {memory / 1e6:.1f} MB"


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
