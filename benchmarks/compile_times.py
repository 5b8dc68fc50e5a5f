"""How long each algorithm's train step takes to trace and compile, without a cache.

python benchmarks/compile_times.py --task Hopper
"""

import argparse
import time

import jax

from rewax.agents.registry import algorithm
from rewax.envs import make

ALGORITHMS = ("sapo", "shac", "apg", "ahac", "rpo", "ppo", "sac", "trajopt")


def seconds(task: str, scale: str, name: str, repeats: int) -> tuple[float, float]:
    """Tracing, and both together [s]; the fastest of several."""
    known, env = algorithm(name), make(task, scale=scale)
    agent, best = known.make(env, known.preset(task, scale)), (float("inf"), float("inf"))
    state = jax.block_until_ready(agent.init(jax.random.key(0)))
    for _ in range(repeats):
        jax.clear_caches()
        start = time.perf_counter()
        lowered = agent.train_step.lower(state)
        traced = time.perf_counter() - start
        lowered.compile()
        best = min(best, (time.perf_counter() - start, traced))
    return best[1], best[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Hopper")
    parser.add_argument("--scale", default="small")
    parser.add_argument("--algorithms", nargs="+", default=ALGORITHMS)
    parser.add_argument("--repeats", type=int, default=2)
    args = parser.parse_args()
    for name in args.algorithms:
        traced, whole = seconds(args.task, args.scale, name, args.repeats)
        print(f"{args.task} {name}: {traced:.1f} s to trace, {whole:.1f} s in all", flush=True)


if __name__ == "__main__":
    main()
