"""XLA's two code generators for a CPU and their levels of optimisation: seconds to compile and to run a train step.

    python benchmarks/quick_compile.py --tasks RollingFlat HandFlip AntRun Hopper
    REWAX_NATIVE=0 python benchmarks/quick_compile.py --tasks RollingFlat       # the physics in XLA too

All programs of a task run in turns in one process; the fastest iteration counts. Needs an XLA that has both generators
(jax 0.10.1).
"""

import argparse
import time

import jax

from rewax import xla_options
from rewax.agents.registry import algorithm
from rewax.envs import make
from rewax.training.loop.compilation import no_garbage_collection

PROGRAMS = {
    "newer, level 3": {},
    "newer, level 1": {"xla_backend_optimization_level": 1},
    "older, level 3": xla_options.QUICK_IN_XLA,
    "older, level 1": xla_options.QUICK,
}


def measure(task: str, scale: str, name: str, iterations: int) -> dict[str, tuple[float, float]]:
    """Seconds to compile, and of the fastest iteration, of each program."""
    known = algorithm(name)
    agent = known.make(make(task, scale=scale), known.preset(task, scale))
    start = jax.jit(agent.init)(jax.random.key(0))
    compiled, seconds, fastest = {}, {}, dict.fromkeys(PROGRAMS, float("inf"))
    with no_garbage_collection():
        lowered = agent.train_step.lower(start)
        for program, options in PROGRAMS.items():
            began = time.perf_counter()
            compiled[program] = lowered.compile(options)
            seconds[program] = time.perf_counter() - began
    states = {program: jax.tree.map(lambda leaf: leaf.copy(), start) for program in PROGRAMS}
    for iteration in range(iterations):
        for program, run in compiled.items():
            began = time.perf_counter()
            states[program], _ = jax.block_until_ready(run(states[program]))
            if iteration > 0:
                fastest[program] = min(fastest[program], time.perf_counter() - began)
    return {program: (seconds[program], fastest[program]) for program in PROGRAMS}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["RollingFlat"])
    parser.add_argument("--scale", default="small")
    parser.add_argument("--algorithm", default="sapo")
    parser.add_argument("--iterations", type=int, default=12, help="the first one is not timed")
    args = parser.parse_args()
    jax.config.update("jax_enable_compilation_cache", False)
    for task in args.tasks:
        for program, (compiling, iteration) in measure(task, args.scale, args.algorithm, args.iterations).items():
            print(f"{task}: {program}: {compiling:.1f} s to compile, {iteration:.3f} s an iteration", flush=True)


if __name__ == "__main__":
    main()
