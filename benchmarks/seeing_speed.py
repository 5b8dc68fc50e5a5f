"""What pictures cost: seconds of depth and of its encoder beside those of a whole train step.

    python benchmarks/seeing_speed.py
    python benchmarks/seeing_speed.py --task GripperLift --envs 8 --resolution 64 --repeats 5
    python benchmarks/seeing_speed.py --beside ../before --repeats 40    # the train step with depth of two checkouts

One process measures all of it, in turns; each number is the least of the repeats. SAPO's policy observes depth and the
critics observe the state. The row of pictures counts two for each control step, its own and that of a new episode; an
environment renders the second one only in steps in which an episode of the batch ends.
"""

import dataclasses
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import tyro

import rewax
from rewax.agents.networks import PictureEncoder
from rewax.agents.presets import sapo_preset
from rewax.agents.sapo import make_sapo
from rewax.envs.named_sensors import default_camera
from rewax.training import enable_compilation_cache


class Convolutions(nn.Module):
    """The layers of ``PictureEncoder`` by ``flax.linen.Conv``."""

    widths: tuple[int, ...]
    features: int

    @nn.compact
    def __call__(self, x: Any) -> Any:
        for i, width in enumerate(self.widths):
            size, stride = ((4, 4), (4, 4)) if i == 0 else ((3, 3), (2, 2))
            x = nn.silu(nn.LayerNorm()(nn.Conv(width, size, stride)(x)))
        return nn.silu(nn.LayerNorm()(nn.Dense(self.features)(x.reshape(-1))))


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the benchmark.

    Attributes:
      task: at scale ``small``.
      envs: environments in the batch.
      resolution: pixels along each side.
      repeats: measurements of each number.
      beside: another checkout: only the train step with depth runs, in turns in both; printed are seconds of the
        processor, which other programs disturb less.
      worker: answer as a process of ``beside`` does.
    """

    task: str = "RollingFlat"
    envs: int = 8
    resolution: int = 64
    repeats: int = 5
    beside: Path | None = None
    worker: bool = False


def train_step(args: Args, *, sees: bool) -> tuple[Callable[[], Any], int]:
    """A function that trains for one iteration, and the control steps of an environment in it."""
    options = {"sensors": ("camera",), "resolution": args.resolution} if sees else {}
    env: Any = rewax.make(args.task, scale="small", **options)
    state = tuple(name for name in env.observation_spec if name != "camera")
    seen = ("camera", *(name for name in state if name.startswith("joint"))) if sees else state
    config = dataclasses.replace(
        sapo_preset(args.task, "small"), num_envs=args.envs, observe=seen, critic_observe=state
    )
    agent = make_sapo(env, config)
    kept = [agent.init(jax.random.key(0))]

    def run() -> Any:
        kept[0], metrics = agent.train_step(kept[0])
        return metrics

    return run, config.steps_in(env)


def pictures(args: Args, count: int) -> Callable[[], Any]:
    """A function that renders ``count`` pictures of each environment, one after another."""
    env: Any = rewax.make(args.task, scale="small")
    camera, up = default_camera(env, args.resolution), np.asarray(env.up)
    physics = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), args.envs)).physics

    def render(physics: Any) -> Any:
        def again(total: Any, _: Any) -> Any:
            # The sum enters the next picture, so that no picture is computed once for all.
            moved = jax.tree.map(
                lambda a: a + 1e-12 * total[0, 0] if jnp.issubdtype(a.dtype, jnp.inexact) else a, physics
            )
            return camera.depth(env.world(moved, up)), None

        return jax.lax.scan(again, jnp.zeros((args.resolution,) * 2), length=count)[0]

    program = jax.jit(jax.vmap(render))
    return lambda: program(physics)


def encoder(args: Args, network: nn.Module, count: int) -> Callable[[], Any]:
    """A function that encodes a batch of pictures, with the gradient of the parameters."""
    batch = jax.random.uniform(jax.random.key(1), (args.envs * count, args.resolution, args.resolution, 1))
    weights: Any = network.init(jax.random.key(2), batch[0])
    program = jax.jit(jax.grad(lambda w, batch: jnp.sum(jax.vmap(lambda x: network.apply(w, x))(batch) ** 2)))
    return lambda: program(weights, batch)


def least(functions: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Least seconds of each function; they run in turns."""
    found = dict.fromkeys(functions, np.inf)
    for repeat in range(repeats + 1):
        for name, function in functions.items():
            began = time.perf_counter()
            jax.block_until_ready(function())
            if repeat:  # the first compiles
                found[name] = min(found[name], time.perf_counter() - began)
    return found


def answer(args: Args) -> None:
    """Seconds of the processor of one train step with depth for each line of standard input."""
    run, _ = train_step(args, sees=True)
    jax.block_until_ready(run())
    for _ in sys.stdin:
        began = time.process_time()
        jax.block_until_ready(run())
        print(time.process_time() - began, flush=True)


def in_turns(args: Args, other: Path) -> None:
    """Compare the train steps of another checkout and of this one."""
    options = [f"--{name}={getattr(args, name)}" for name in ("task", "envs", "resolution")]
    command = [sys.executable, __file__, *options, "--worker"]
    checkouts = (other, Path(__file__).parent.parent)
    processes = [
        subprocess.Popen(
            command, env={**os.environ, "PYTHONPATH": str(path.resolve())}, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, text=True,
        )
        for path in checkouts
    ]  # fmt: skip
    found: list[list[float]] = [[], []]
    for _ in range(args.repeats):
        for process, seconds in zip(processes, found, strict=True):
            assert process.stdin is not None and process.stdout is not None
            process.stdin.write("\n")
            process.stdin.flush()
            seconds.append(float(process.stdout.readline()))
    for process in processes:
        process.communicate()
    before, after = (statistics.median(seconds) for seconds in found)
    print(f"processor seconds, medians: {before:.3f} there, {after:.3f} here, ratio {after / before:.3f}")


def main(args: Args) -> None:
    if args.beside is not None:
        in_turns(args, args.beside)
        return
    enable_compilation_cache()
    if args.worker:
        answer(args)
        return
    seeing, steps = train_step(args, sees=True)
    blind, _ = train_step(args, sees=False)
    preset = sapo_preset(args.task, "small")
    widths, features = preset.picture_widths, preset.picture_features
    functions = {
        "train step with depth": seeing,
        "train step from the state": blind,
        f"pictures of {steps} control steps": pictures(args, 2 * steps),
        "PictureEncoder, forward and backward": encoder(args, PictureEncoder(widths, features, nn.silu, 1.0), steps),
        "the same by flax.linen.Conv": encoder(args, Convolutions(widths, features), steps),
    }
    print(f"{args.task} small, {args.envs} environments, {args.resolution} x {args.resolution} pixels, {steps} steps")
    print("| what | seconds | share of the train step |\n|---|---|---|")
    found = least(functions, args.repeats)
    for name, seconds in found.items():
        print(f"| {name} | {seconds:.3f} | {seconds / found['train step with depth']:.0%} |")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
