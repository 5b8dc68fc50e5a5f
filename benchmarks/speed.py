"""How fast RollingFlat is: compile seconds, milliseconds per env step, particle-substeps per second, peak memory.

Each measurement runs in a process of its own, so that peak memory is its own; the cold compile uses an empty cache
directory, the warm one what the cold one left there.

    python benchmarks/speed.py                 # both scales
    python benchmarks/speed.py --train-step    # also one whole SAPO train step of each scale
"""

import dataclasses
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time

import tyro


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    scales: tuple[str, ...] = ("small", "paper")
    num_envs: int = 1
    """Environments side by side, for the env step."""
    repeats: int = 5
    train_step: bool = False
    """Also measure SAPO's whole train step with the preset's size, run once (minutes at scale paper on a CPU)."""
    out: str = ""
    """Also write all numbers to this JSON file."""
    worker: str = ""
    """Internal: what one process measures."""


def measure(args: Args, what: str, scale: str) -> dict[str, float]:
    """One measurement, in this process."""
    import jax
    import jax.numpy as jnp

    import rewax
    from rewax.agents.presets import sapo_preset
    from rewax.agents.sapo import make_sapo
    from rewax.training.cache import enable_compilation_cache

    enable_compilation_cache()
    env = rewax.make("RollingFlat", scale=scale)
    if what == "train_step":
        agent = make_sapo(env, sapo_preset("RollingFlat", scale))
        inputs = (jax.block_until_ready(agent.init(jax.random.key(0))),)
        function = agent.train_step
    else:
        state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), args.num_envs))
        action = jnp.tile(jnp.asarray([0.5, -1.0, 0.0]), (args.num_envs, 1))

        def step(state, action):
            new = jax.vmap(env.step)(state, action)
            return new.reward.sum(), new

        backward = jax.value_and_grad(lambda s, a: step(s, a)[0], argnums=1)
        function = jax.jit(step if what == "forward" else backward)
        inputs = (state, action)
    began = time.perf_counter()
    compiled = function.lower(*inputs).compile()
    compile_s = time.perf_counter() - began
    if what != "train_step":  # which takes minutes at scale paper: no warm-up for that one
        jax.block_until_ready(compiled(*inputs))
    seconds = []
    for _ in range(args.repeats):
        began = time.perf_counter()
        jax.block_until_ready(compiled(*inputs))
        seconds.append(time.perf_counter() - began)
    work = args.num_envs * env.num_substeps * env.rest_positions.shape[0]
    return {
        "compile_s": compile_s,
        "run_ms": 1e3 * min(seconds, default=math.inf),
        "particle_substeps_per_s": work / min(seconds, default=math.inf),
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def run_worker(args: Args, what: str, scale: str, cache: str, repeats: int) -> dict[str, float]:
    """One measurement, in a fresh process with the given cache directory."""
    command = [sys.executable, __file__, "--worker", f"{what}:{scale}", "--num-envs", str(args.num_envs)]
    command += ["--repeats", str(repeats)]
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache, "TF_CPP_MIN_LOG_LEVEL": "3"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"measuring {what} at scale {scale} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main(args: Args) -> None:
    if args.worker:
        print(json.dumps(measure(args, *args.worker.split(":"))))
        return
    rows = {}
    header = f"{'':24s} {'compile cold':>13s} {'warm':>8s} {'ms':>10s} {'M part.-substeps/s':>19s} {'peak GB':>8s}"
    print(header, flush=True)
    for scale in args.scales:
        for what in ["forward", "backward"] + ["train_step"] * args.train_step:
            with tempfile.TemporaryDirectory() as cache:
                once = what == "train_step"
                cold = run_worker(args, what, scale, cache, 1 if once else args.repeats)
                warm = run_worker(args, what, scale, cache, 0 if once else args.repeats)
            row = {**min(cold, warm, key=lambda r: r["run_ms"]), "compile_s": warm["compile_s"]}
            row["compile_cold_s"] = cold["compile_s"]
            rows[f"{scale} {what}"] = row
            rate = "" if what == "train_step" else f"{row['particle_substeps_per_s'] / 1e6:19.2f}"
            print(
                f"{scale + ' ' + what:24s} {row['compile_cold_s']:11.1f} s {row['compile_s']:6.1f} s "
                f"{row['run_ms']:10.1f} {rate:>19s} {row['peak_gb']:8.2f}",
                flush=True,
            )
        ratio = rows[f"{scale} backward"]["run_ms"] / rows[f"{scale} forward"]["run_ms"]
        print(f"{scale}: forward + backward = {ratio:.1f} x forward")
    if args.out:
        with open(args.out, "w") as file:
            json.dump(rows, file, indent=2)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
