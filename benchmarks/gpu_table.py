"""HandFlip with 2500 and 30,000 particles per environment: the table of rates and memory that the paper's authors gave.

Theirs, on an RTX 4090, forward: 2500 particles: 210 env steps/s with one environment, 1400 with 32, 6.16 GB; 30,000
particles: 85, 118, 150, 169, 172 and 179 env steps/s with 1, 2, 4, 8, 16 and 32 environments, 1.50 to 18.71 GB.

The scene with more particles is the same dough, divided into more of them. Prints rates forward, and forward and
backward of one control step, and what XLA allocates for each.

    python benchmarks/gpu_table.py
    python benchmarks/gpu_table.py --particles 2500 --envs 1 4
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import tyro
from scaling import best

import rewax
from rewax.envs.tasks.hand_flip import REFERENCE, mirrored_disc
from rewax.training import enable_compilation_cache

PAPER = {(2500, 1): 210, (2500, 32): 1400}
PAPER |= {(30_000, n): rate for n, rate in zip((1, 2, 4, 8, 16, 32), (85, 118, 150, 169, 172, 179), strict=True)}
"""Env steps per second of (particles, environments)."""


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    particles: tuple[int, ...] = (2500, 30_000)
    envs: tuple[int, ...] = (32, 1, 8, 2, 4, 16)
    repeats: int = 3
    backward: bool = True


def with_particles(num_particles: int) -> Any:
    """HandFlip's dough, divided into so many particles."""
    env: Any = rewax.make("HandFlip", scale="paper")
    r = REFERENCE
    x = mirrored_disc(r["center"], r["radius"], r["half_thickness"], num_particles)
    volume = jnp.asarray(r["particle_volume"] * r["num_particles"] / num_particles)
    return env.replace(scene=env.scene.replace(particle_volume=volume), rest_positions=x)


def main(args: Args) -> None:
    enable_compilation_cache()
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}; HandFlip, 40 substeps per env step")
    print(
        f"{'particles':>10s} {'envs':>5s} {'pass':9s} {'env steps/s':>12s} {'paper, 4090':>12s} "
        f"{'part.-substeps/s':>17s} {'GB':>7s}"
    )
    for count in args.particles:
        env = with_particles(count)
        for num_envs in args.envs:
            for name in ("forward", "backward")[: 1 + args.backward]:
                try:
                    seconds, size = measure(env, num_envs, name, args.repeats)
                except Exception as error:  # out of memory: the table goes on
                    print(f"{count:10d} {num_envs:5d} {name:9s} failed: {str(error).splitlines()[0][:90]}", flush=True)
                    continue
                paper = PAPER.get((count, num_envs), "") if name == "forward" else ""
                print(
                    f"{count:10d} {num_envs:5d} {name:9s} {num_envs / seconds:12.1f} {paper:>12} "
                    f"{num_envs * count * env.num_substeps / seconds:17.3g} {size / 1e9:7.2f}",
                    flush=True,
                )


def measure(env: Any, num_envs: int, name: str, repeats: int) -> tuple[float, float]:
    """Seconds of a control step of all environments, and bytes that XLA allocates."""
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num_envs))
    action = jax.random.uniform(jax.random.key(1), (num_envs, *env.action_spec.shape), minval=-1.0, maxval=1.0)

    def forward(state: Any, action: jax.Array) -> tuple[jax.Array, Any]:
        new = jax.vmap(env.step)(state, action)
        return new.reward.sum(), new

    function = forward if name == "forward" else jax.value_and_grad(lambda s, a: forward(s, a)[0], argnums=1)
    compiled = jax.jit(function).lower(state, action).compile()
    memory = compiled.memory_analysis()
    size = memory.temp_size_in_bytes + memory.output_size_in_bytes + memory.argument_size_in_bytes if memory else 0.0
    return best(lambda: compiled(state, action), repeats), size


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
