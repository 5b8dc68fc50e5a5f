"""How fast articulated rigid bodies are: steps per second, seconds to compile, memory; forward and with the gradient.

A rollout of 32 substeps in 64 environments with random controls; the gradient is that of a random combination of the
last positions by first positions, velocities and controls. Per second of the clock, and of processor time: other jobs
on the machine disturb that less. Each line's numbers come from a process of its own, whose cache of compiled programs
is empty at first (cold) and then what the cold one left there (warm); the processes of a model take turns.

    python benchmarks/rigid.py                                     # ant, hopper, hand, humanoid under both laws
    python benchmarks/rigid.py --models ant --stock                # beside stock mjx.step made differentiable
    python benchmarks/rigid.py --out new.json --compare old.json   # beside the numbers of an earlier run
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
from collections.abc import Callable
from typing import Any

import tyro
from rigid_models import MODELS, Contact, penalty_of


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    models: tuple[str, ...] = tuple(MODELS)
    laws: tuple[str, ...] = ("constraints", "penalty")
    stock: bool = False
    """Also measure stock ``mjx.step`` with an implicit derivative of its solver (``rigid_stock.py``)."""
    num_envs: int = 64
    num_steps: int = 32
    repeats: int = 10
    out: str = ""
    """Also write all numbers to this JSON file."""
    compare: str = ""
    """JSON file of an earlier run: print old / new for each number."""
    worker: str = ""
    """Internal: what one process measures."""


PROGRAMS = ("forward", "gradient")


def make_rollout(name: str, kind: str) -> tuple[Callable[..., Any], Any]:
    """Last positions by first positions, velocities and controls; the model as MuJoCo has it."""
    import jax

    from rewax.physics import rigid

    mjcf = MODELS[name](Contact())
    penalty = penalty_of(name) if kind == "penalty" else None
    model = rigid.load(mjcf, penalty=penalty)
    if kind == "stock":
        import rigid_stock

        rigid_stock.install()
        return rigid_stock.make_rollout(mjcf), model

    def rollout(qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array) -> jax.Array:
        state = rigid.initial_state(model, qpos, qvel)
        return jax.lax.scan(lambda s, c: (rigid.step(model, s, c), None), state, ctrl)[0].qpos

    return rollout, model


def serve(args: Args, name: str, kind: str) -> None:
    """One process: compile and tell; then run and tell for every line of input."""
    import jax
    import jax.numpy as jnp

    rollout, model = make_rollout(name, kind)
    keys = jax.random.split(jax.random.key(0), 3)
    weights = jax.random.normal(keys[0], (model.num_positions,))
    inputs = (
        jnp.tile(model.home, (args.num_envs, 1)),
        0.1 * jax.random.normal(keys[1], (args.num_envs, model.num_dofs)),
        0.3 * jax.random.normal(keys[2], (args.num_envs, args.num_steps, model.num_actuators)),
    )

    def outcome(*inputs: jax.Array) -> jax.Array:
        return rollout(*inputs) @ weights

    functions = (outcome, jax.value_and_grad(outcome, argnums=(0, 1, 2)))
    compiled, numbers = {}, {}
    for what, function in zip(PROGRAMS, functions, strict=True):
        lowered, trace = timed(lambda function=function: jax.jit(jax.vmap(function)).lower(*inputs))
        compiled[what], compile_ = timed(lowered.compile)
        result, _ = timed(lambda what=what: jax.block_until_ready(compiled[what](*inputs)))
        numbers[what] = {
            "trace_cpu_s": trace[1],
            "compile_cpu_s": compile_[1],
            "total_s": trace[0] + compile_[0],
            "temp_mb": compiled[what].memory_analysis().temp_size_in_bytes / 1e6,
            "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9,
            "finite": float(all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(result))),
        }
    print(json.dumps(numbers), flush=True)
    for _ in sys.stdin:
        seconds = {w: timed(lambda w=w: jax.block_until_ready(compiled[w](*inputs)))[1] for w in PROGRAMS}
        print(json.dumps(seconds), flush=True)


def timed(run: Callable[[], Any]) -> tuple[Any, tuple[float, float]]:
    """What a call returns; the seconds it took by the clock, and of processor time."""
    clock, cpu = time.perf_counter(), time.process_time()
    result = run()
    return result, (time.perf_counter() - clock, time.process_time() - cpu)


class Worker:
    """A process that measures."""

    def __init__(self, args: Args, name: str, kind: str, cache: str) -> None:
        options = [f"--{key.replace('_', '-')}={getattr(args, key)}" for key in ("num_envs", "num_steps")]
        environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache, "TF_CPP_MIN_LOG_LEVEL": "3"}
        self.process = subprocess.Popen(
            [sys.executable, __file__, f"--worker={name}:{kind}", *options],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True,
        )  # fmt: skip
        self.compiled = self.listen()

    def listen(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError("a measuring process failed: its message is above")
        return json.loads(line)

    def run(self) -> dict[str, Any]:
        assert self.process.stdin is not None
        print("run", file=self.process.stdin, flush=True)
        return self.listen()

    def close(self) -> None:
        self.process.communicate()


def measure(args: Args, name: str) -> dict[str, dict[str, float]]:
    """All numbers of a model, by kind and program."""
    kinds = [*args.laws, *(["stock"] if args.stock else [])]
    with tempfile.TemporaryDirectory() as folder:
        caches = {kind: os.path.join(folder, kind) for kind in kinds}
        workers = {kind: Worker(args, name, kind, caches[kind]) for kind in kinds}
        best = {(kind, what): (math.inf, math.inf) for kind in kinds for what in PROGRAMS}
        for _ in range(args.repeats):
            for kind, worker in workers.items():
                for what, seconds in worker.run().items():
                    best[kind, what] = tuple(map(min, best[kind, what], seconds))
        for worker in workers.values():
            worker.close()
        rows = {}
        for kind in kinds:
            warm = Worker(args, name, kind, caches[kind])
            warm.close()
            for what in PROGRAMS:
                clock, cpu = best[kind, what]
                rows[f"{name} {kind} {what}"] = {
                    **workers[kind].compiled[what],
                    "warm_total_s": warm.compiled[what]["total_s"],
                    "steps_per_s": args.num_envs * args.num_steps / clock,
                    "steps_per_cpu_s": args.num_envs * args.num_steps / cpu,
                }
    return rows


def describe(name: str, row: dict[str, float]) -> str:
    seconds = f"{row['trace_cpu_s']:6.1f} + {row['compile_cpu_s']:5.1f}"
    seconds += f" {row['total_s']:8.1f} {row['warm_total_s']:6.1f}"
    rates = f"{row['steps_per_s']:12,.0f} {row['steps_per_cpu_s']:12,.0f}"
    memory = f"{row['temp_mb']:7.1f} {row['peak_gb']:7.2f}"
    return f"{name:32s} {seconds} {rates} {memory}" + ("" if row["finite"] else "   NOT FINITE")


def main(args: Args) -> None:
    if args.worker:
        serve(args, *args.worker.split(":"))
        return
    old = {}
    if args.compare:
        with open(args.compare) as file:
            old = json.load(file)
    rows = {}
    print(
        f"{'':32s} {'trace + compile':>14s} {'cold':>8s} {'warm':>6s} {'steps/s':>12s} {'per CPU-s':>12s} {'temp':>7s} "
        f"{'peak':>7s}\n{'':32s} {'CPU-s':>14s} {'s':>8s} {'s':>6s} {'':>12s} {'':>12s} {'MB':>7s} {'GB':>7s}"
    )
    for name in args.models:
        rows.update(measure(args, name))
        for key in [key for key in rows if key.startswith(name + " ")]:
            print(describe(key, rows[key]), flush=True)
            stock = rows.get(f"{name} stock {key.split()[-1]}")
            for what, other in (("stock / this", stock if " stock " not in key else None), ("old / new", old.get(key))):
                if other:
                    total = sum(other[k] for k in ("trace_cpu_s", "compile_cpu_s"))
                    total /= sum(rows[key][k] for k in ("trace_cpu_s", "compile_cpu_s"))
                    speed = rows[key]["steps_per_cpu_s"] / other["steps_per_cpu_s"]
                    print(f"{'':34s}{what}: trace + compile {total:.2f}, CPU time of a step {speed:.2f}", flush=True)
    if args.out:
        with open(args.out, "w") as file:
            json.dump(rows, file, indent=2)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
