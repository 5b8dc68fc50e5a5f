"""Two checkouts beside each other: env steps and their gradients, in turns, so that what else runs counts for both.

    python benchmarks/in_turns.py ../before . --tasks RollingFlat AntRun --scales paper small --num-envs 1 64

Each checkout has a process of its own, which compiles and then waits. In turns each runs a few times. Printed are
the best time of each, and the ratio of time of the best turns, of the median of turns, and of processor time.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

WHAT = ("forward", "forward + backward")


def worker(task: str, scale: str, num_envs: int) -> None:
    """Compile, then run what standard input asks for: which program, how often."""
    import jax
    import numpy as np

    import rewax

    env = rewax.make(task, scale=scale)
    keys = jax.random.split(jax.random.key(0), num_envs)
    state = jax.vmap(env.reset)(keys)
    action = jax.vmap(lambda key: jax.random.uniform(key, env.action_spec.shape, minval=-1.0, maxval=1.0))(keys)

    def step(state: Any, action: Any) -> Any:
        after = jax.vmap(env.step)(state, action)
        return after.reward.sum(), after

    began = time.perf_counter()
    both = jax.value_and_grad(lambda state, action: step(state, action)[0], argnums=1)
    programs = [jax.jit(function).lower(state, action).compile() for function in (step, both)]
    seconds = time.perf_counter() - began
    results = [jax.block_until_ready(program(state, action)) for program in programs]
    norm = float(np.linalg.norm(results[1][1]))
    print(json.dumps({"compile": seconds, "reward": float(results[0][0]), "gradient": norm}), flush=True)
    for line in sys.stdin:
        which, repeats = map(int, line.split())
        wall = processor = float("inf")
        for _ in range(repeats):
            start, used = time.perf_counter(), time.process_time()
            jax.block_until_ready(programs[which](state, action))
            wall, processor = min(wall, time.perf_counter() - start), min(processor, time.process_time() - used)
        print(json.dumps([wall, processor]), flush=True)


def compare(checkouts: list[Path], task: str, scale: str, num_envs: int, turns: int) -> None:
    processes = [_started(path, task, scale, num_envs) for path in checkouts]
    said = [json.loads(_line(p)) for p in processes]
    compile_s, rewards, gradients = (", ".join(f"{s[k]:.7g}" for s in said) for k in ("compile", "reward", "gradient"))
    print(f"{task} {scale} x {num_envs}: compiled in {compile_s} s; reward {rewards}; gradient {gradients}", flush=True)
    for which, what in enumerate(WHAT):
        repeats = 2 if json.loads(_asked(processes[0], which, 1))[0] > 0.05 else 20
        found: list[list[list[float]]] = [[], []]
        for _ in range(turns):
            for process, times in zip(processes, found, strict=True):
                times.append(json.loads(_asked(process, which, repeats)))
        wall, processor = ([min(t[k] for t in times) for times in found] for k in (0, 1))
        median = statistics.median(b[0] / a[0] for a, b in zip(*found, strict=True))
        print(
            f"  {what}: {1e3 * wall[0]:.2f} ms, {1e3 * wall[1]:.2f} ms; ratio {wall[1] / wall[0]:.2f}, "
            f"median of turns {median:.2f}, processor time {processor[1] / processor[0]:.2f}",
            flush=True,
        )
    for process in processes:
        process.communicate()


def _started(path: Path, task: str, scale: str, num_envs: int) -> "subprocess.Popen[str]":
    command = [sys.executable, __file__, "--worker", task, scale, str(num_envs)]
    environment = {**os.environ, "PYTHONPATH": str(path.resolve())}
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)


def _asked(process: "subprocess.Popen[str]", which: int, repeats: int) -> str:
    assert process.stdin
    process.stdin.write(f"{which} {repeats}\n")
    process.stdin.flush()
    return _line(process)


def _line(process: "subprocess.Popen[str]") -> str:
    assert process.stdout
    line = process.stdout.readline()
    if not line:
        sys.exit("a worker ended: its error stands above")
    return line


def main() -> None:
    if sys.argv[1:2] == ["--worker"]:
        worker(sys.argv[2], sys.argv[3], int(sys.argv[4]))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", type=Path, nargs=2, help="folders that hold the package, before and after")
    parser.add_argument("--tasks", nargs="+", default=["RollingFlat"])
    parser.add_argument("--scales", nargs="+", default=["paper"])
    parser.add_argument("--num-envs", type=int, nargs="+", default=[1])
    parser.add_argument("--turns", type=int, default=8)
    arguments = parser.parse_args()
    for scale in arguments.scales:
        for task in arguments.tasks:
            for num_envs in arguments.num_envs:
                compare(arguments.checkouts, task, scale, num_envs, arguments.turns)


if __name__ == "__main__":
    main()
