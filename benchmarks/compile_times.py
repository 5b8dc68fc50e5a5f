"""How long programs take to trace and compile, without a cache: ``reset`` and ``step``, and train steps.

python benchmarks/compile_times.py                                     # all tasks, SAPO
python benchmarks/compile_times.py --tasks Hopper --algorithms sapo shac apg ahac rpo ppo sac trajopt
python benchmarks/compile_times.py --tasks RollingFlat --repeats 2 --quick-compile on      # beside: off
"""

import argparse
import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rewax.agents.registry import algorithm
from rewax.envs import make
from rewax.envs.registry import list_envs
from rewax.training.loop.compilation import compiler_options, no_garbage_collection


def best(lower: Callable[[], list[Any]], options: dict[str, Any], repeats: int) -> tuple[float, ...]:
    """Seconds to trace some programs, to trace and compile them, and of all processors; the fastest of several."""
    found = (float("inf"),) * 3
    for _ in range(repeats):
        jax.clear_caches()
        with no_garbage_collection():
            start, processor = time.perf_counter(), time.process_time()
            lowered = lower()
            traced = time.perf_counter() - start
            for program in lowered:
                program.compile(options)
        found = min(found, (time.perf_counter() - start, traced, time.process_time() - processor))
    return found[1], found[0], found[2]


def reset_and_step(task: str, scale: str) -> Callable[[], list[Any]]:
    env = make(task, scale=scale)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    action = jnp.zeros(env.action_spec.shape)
    return lambda: [jax.jit(env.reset).lower(jax.random.key(0)), jax.jit(env.step).lower(state, action)]


def train_step(task: str, scale: str, name: str, quick: str) -> tuple[Callable[[], list[Any]], dict[str, Any]]:
    known, env = algorithm(name), make(task, scale=scale)
    config = known.preset(task, scale)
    if quick != "preset":
        config = dataclasses.replace(config, quick_compile=quick == "on")
    agent = known.make(env, config)
    state = jax.eval_shape(agent.init, jax.random.key(0))
    return lambda: [agent.train_step.lower(state)], compiler_options(agent)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list_envs())
    parser.add_argument("--scale", default="small")
    parser.add_argument("--algorithms", nargs="*", default=["sapo"])
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--quick-compile", choices=["preset", "on", "off"], default="preset")
    args = parser.parse_args()
    for task in args.tasks:
        programs: dict[str, Any] = {"reset + step": (reset_and_step(task, args.scale), {})}
        programs |= {name: train_step(task, args.scale, name, args.quick_compile) for name in args.algorithms}
        for name, (lower, options) in programs.items():
            traced, whole, cpu = best(lower, options, args.repeats)
            seconds = f"{traced:.1f} s to trace, {whole:.1f} s in all, {cpu:.1f} s of processors"
            print(f"{task} {args.scale}, {name}: {seconds}", flush=True)


if __name__ == "__main__":
    main()
