"""What the cache of bytecode saves: seconds to lower a step and its gradient, with an empty cache and with a full one.

    python benchmarks/bytecode_cache.py RollingFlat AntRun HandReorient

Each number is of a process of its own. Both processes must load the same bytecode.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from typing import Any

import jax
import jax.numpy as jnp

import rewax
from rewax.lowering import kernels, machine


def lowered(task: str, home: str) -> dict[str, Any]:
    """Seconds to trace and to lower, and the numbers of the bytecode that was loaded."""
    jax.config.update("jax_compilation_cache_dir", home)
    loaded, load = [], machine.load

    def spy(*args: Any) -> Any:
        loaded.append(load(*args))
        return loaded[-1]

    machine.load = kernels.load = spy
    env = rewax.make(task, scale="small")
    state = jax.eval_shape(env.reset, jax.random.key(0))
    action = jax.ShapeDtypeStruct(env.action_spec.shape, jnp.float32)
    machine.register(machine.machine(jnp.dtype(jnp.float32)))  # its C++ is built once for all programs
    start = time.perf_counter()
    traced = jax.jit(jax.value_and_grad(lambda s, a: env.step(s, a).reward, argnums=1)).trace(state, action)
    middle = time.perf_counter()
    traced.lower()
    seconds = (middle - start, time.perf_counter() - middle)
    return {"seconds": seconds, "loaded": sorted(number for number, _ in loaded)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="+")
    parser.add_argument("--home", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.home:
        print(json.dumps(lowered(args.tasks[0], args.home)))
        return 0
    print("| task | trace | lower, empty cache | lower, full cache |\n|---|---|---|---|")
    for task in args.tasks:
        with tempfile.TemporaryDirectory() as home:
            command = [sys.executable, __file__, task, "--home", home]
            empty, full = (
                json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
                for _ in range(2)
            )
        if empty["loaded"] != full["loaded"]:
            raise SystemExit(f"{task}: other bytecode was read than was made")
        trace, full_s, empty_s = full["seconds"][0], full["seconds"][1], empty["seconds"][1]
        print(f"| {task} | {trace:.1f} s | {empty_s:.1f} s | {full_s:.1f} s |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
