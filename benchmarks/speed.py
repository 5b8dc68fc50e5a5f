"""How fast tasks are: compile seconds, milliseconds per env step, particle-substeps per second, peak memory.

Each measurement runs in a process of its own, so that peak memory is its own; the cold compile uses an empty cache
directory, the warm one what the cold one left there. Peak memory is that of the warm process: to compile
needs memory too. A train step is measured beside the gradient of the same
segment of the same environments without policy and critics. The difference is the time spent outside physics.

    python benchmarks/speed.py                                       # every registered task at both scales
    python benchmarks/speed.py --scales small --train-step           # also one SAPO train step
    python benchmarks/speed.py --out new.json --compare old.json     # beside the numbers of an earlier run
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


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    tasks: tuple[str, ...] = ()
    """Names of environments; none: all that are registered."""
    scales: tuple[str, ...] = ("small", "paper")
    num_envs: int = 1
    """Environments side by side, for the env step."""
    repeats: int = 5
    train_step: bool = False
    """Also measure SAPO's whole train step with the preset's size (minutes at scale paper on a CPU)."""
    out: str = ""
    """Also write all numbers to this JSON file."""
    compare: str = ""
    """JSON file of an earlier run: print old / new for each number."""
    worker: str = ""
    """Internal: what one process measures."""


ENOUGH_S = 20.0
"""A train step that takes longer than this is run once only."""


def measure(args: Args, what: str, task: str, scale: str) -> dict[str, float]:
    """One measurement, in this process."""
    import jax

    import rewax
    from rewax.training import enable_compilation_cache

    enable_compilation_cache()
    env: Any = rewax.make(task, scale=scale)
    if what == "train_step":
        return measure_train_step(args, env, task, scale)
    function, (state, action) = control_step(env, what, args.num_envs)
    run, compile_s = compiled(function, state, action)
    run()
    seconds = min((timed(run) for _ in range(args.repeats)), default=math.inf)
    numbers = {"compile_s": compile_s, "run_ms": 1e3 * seconds, "peak_gb": peak_gb()}
    if hasattr(env, "num_substeps") and hasattr(env, "particles"):
        num_particles = env.particles(jax.tree.map(lambda a: a[0], state.physics)).shape[0]
        numbers["particle_substeps_per_s"] = args.num_envs * env.num_substeps * num_particles / seconds
    return numbers


def control_step(env: Any, what: str, num_envs: int) -> tuple[Callable[..., Any], tuple[Any, Any]]:
    """A control step of all environments, or its value and gradient by the actions, with states and random actions."""
    import jax

    spec = env.action_spec
    keys = jax.random.split(jax.random.key(0), num_envs)
    state = jax.vmap(env.reset)(keys)
    action = jax.vmap(lambda key: jax.random.uniform(key, spec.shape, minval=-1.0, maxval=1.0))(keys)

    def step(state: Any, action: jax.Array) -> tuple[jax.Array, Any]:
        new = jax.vmap(env.step)(state, action)
        return new.reward.sum(), new

    backward = jax.value_and_grad(lambda s, a: step(s, a)[0], argnums=1)
    return (step if what == "forward" else backward), (state, action)


def sapo(env: Any, task: str, scale: str) -> tuple[Any, Any, Any, float]:
    """The preset, the first training state, the compiled train step, and the seconds that compiling took."""
    import jax
    from rich.console import Console

    from rewax.agents.presets import sapo_preset
    from rewax.agents.sapo import make_sapo
    from rewax.training import compile_train_step

    config = sapo_preset(task, scale)
    agent = make_sapo(env, config)
    ts = jax.block_until_ready(agent.init(jax.random.key(0)))
    began = time.perf_counter()
    program = compile_train_step(agent, ts, Console(quiet=True))
    return config, ts, program, time.perf_counter() - began


def program(what: str, env: Any, task: str, scale: str, num_envs: int) -> tuple[Any, Callable[[], Any]]:
    """The compiled control step, its gradient or train step, and a call that runs it."""
    import jax

    if what == "train_step":
        _, ts, program, _ = sapo(env, task, scale)
        return program, lambda: jax.block_until_ready(program(ts))
    function, inputs = control_step(env, what, num_envs)
    program = jax.jit(function).lower(*inputs).compile()
    return program, lambda: jax.block_until_ready(program(*inputs))


def measure_train_step(args: Args, env: Any, task: str, scale: str) -> dict[str, float]:
    """SAPO's train step; once it is compiled, beside its physics alone, taking turns."""
    import jax
    import jax.numpy as jnp

    from rewax.agents.rollout import rollout
    from rewax.envs.wrappers import AutoReset

    config, ts, program, compile_s = sapo(env, task, scale)
    train_step = lambda: jax.block_until_ready(program(ts))  # noqa: E731
    numbers = {"compile_s": compile_s, "run_ms": math.inf, "peak_gb": peak_gb()}
    if args.repeats == 0:
        return numbers
    seconds = timed(train_step)
    numbers["peak_gb"] = peak_gb()

    def physics(action: jax.Array, state: Any, key: jax.Array) -> jax.Array:
        """A sum that depends on everything that the policy and the critics observe."""
        policy = lambda obs, key: (action, {})  # noqa: E731
        options = {"horizon": config.horizon, "differentiate": config.differentiate}
        _, transitions = rollout(AutoReset(env=env), state, policy, key, **options)
        seen = jax.tree.map(jnp.sum, (transitions.reward, transitions.obs, transitions.next_obs))
        return sum(jax.tree.leaves(seen))  # type: ignore[return-value]

    actions = jnp.zeros((config.num_envs, *env.action_spec.shape))
    keys = jax.random.split(jax.random.key(0), config.num_envs)
    alone, _ = compiled(jax.vmap(jax.value_and_grad(physics)), actions, ts.environments.state, keys)
    rounds = max(args.repeats, 3) if seconds < ENOUGH_S else 1
    alone_seconds = math.inf
    for _ in range(rounds):
        alone_seconds = min(alone_seconds, timed(alone))
        if rounds > 1:
            seconds = min(seconds, timed(train_step))
    return {**numbers, "run_ms": 1e3 * seconds, "physics_ms": 1e3 * alone_seconds}


def compiled(function: Callable[..., Any], *inputs: Any) -> tuple[Callable[[], Any], float]:
    """A call with these inputs, and the seconds from Python to machine code."""
    import jax

    began = time.perf_counter()
    program = (function if hasattr(function, "lower") else jax.jit(function)).lower(*inputs).compile()
    seconds = time.perf_counter() - began
    return lambda: jax.block_until_ready(program(*inputs)), seconds


def timed(run: Callable[[], Any]) -> float:
    began = time.perf_counter()
    run()
    return time.perf_counter() - began


def peak_gb() -> float:
    """Of this process so far: of the accelerator if there is one that tells, else of main memory."""
    import jax

    stats = jax.devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in stats:
        return stats["peak_bytes_in_use"] / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def run_worker(args: Args, what: str, task: str, scale: str, cache: str, repeats: int) -> dict[str, float]:
    """One measurement, in a fresh process with the given cache directory."""
    command = [sys.executable, __file__, "--worker", f"{what}:{task}:{scale}", "--num-envs", str(args.num_envs)]
    command += ["--repeats", str(repeats)]
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache, "TF_CPP_MIN_LOG_LEVEL": "3"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"measuring {what} of {task} at scale {scale} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def measure_cold_and_warm(args: Args, what: str, task: str, scale: str) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as cache:
        cold = run_worker(args, what, task, scale, cache, 0 if what == "train_step" else args.repeats)
        warm = run_worker(args, what, task, scale, cache, args.repeats)
    row = min(cold, warm, key=lambda r: r["run_ms"])
    return {**row, **{key: warm[key] for key in ("compile_s", "peak_gb")}, "compile_cold_s": cold["compile_s"]}


def describe(name: str, row: dict[str, float]) -> str:
    rate = f"{row['particle_substeps_per_s'] / 1e6:19.2f}" if "particle_substeps_per_s" in row else " " * 19
    text = (
        f"{name:32s} {row['compile_cold_s']:11.1f} s {row['compile_s']:6.1f} s {row['run_ms']:10.1f} {rate} "
        f"{row['peak_gb']:8.2f}"
    )
    if "physics_ms" in row:
        text += f"   outside physics {max(0.0, 1.0 - row['physics_ms'] / row['run_ms']):.0%}"
    return text


def main(args: Args) -> None:
    if args.worker:
        print(json.dumps(measure(args, *args.worker.split(":"))))
        return
    import rewax

    old = {}
    if args.compare:
        with open(args.compare) as file:
            old = json.load(file)
    rows = {}
    print(f"{'':32s} {'compile cold':>13s} {'warm':>8s} {'ms':>10s} {'M part.-substeps/s':>19s} {'peak GB':>8s}")
    for task in args.tasks or rewax.list_envs():
        for scale in args.scales:
            for what in ["forward", "backward"] + ["train_step"] * args.train_step:
                name = f"{task} {scale} {what}"
                rows[name] = measure_cold_and_warm(args, what, task, scale)
                print(describe(name, rows[name]), flush=True)
                if name in old:
                    keys = ("compile_cold_s", "compile_s", "run_ms", "peak_gb")
                    ratios = [f"{key} {old[name][key] / rows[name][key]:.2f} x" for key in keys]
                    print(f"{'':32s} old / new: {', '.join(ratios)}", flush=True)
            ratio = rows[f"{task} {scale} backward"]["run_ms"] / rows[f"{task} {scale} forward"]["run_ms"]
            print(f"{task} {scale}: forward + backward = {ratio:.1f} x forward", flush=True)
    if args.out:
        with open(args.out, "w") as file:
            json.dump(rows, file, indent=2)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
