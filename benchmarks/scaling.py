"""How the MPM scales with environments and particles: rates, memory, and the distance from the memory's bandwidth.

An elastic block falls onto a slippery floor. One command measures everything and writes a table, a JSON and a picture:

    python benchmarks/scaling.py --out docs/pictures/scaling          # sizes follow the device
    python benchmarks/scaling.py --envs 1 8 32 --particles 1000 10000 --out /tmp/scaling

The floor is the time in which the device copies what a substep cannot avoid to read and write: the particles' state
once each way, and the fields of the touched nodes. It is measured with a copy of an array of 256 MB.
"""

import dataclasses
import json
import math
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import tyro

from rewax.physics import mpm
from rewax.physics.mpm import FixedCorotated, Grid, Material, Wall, Walls, count_nodes
from rewax.physics.shapes import fill_box
from rewax.training import enable_compilation_cache

FLOATS_PER_PARTICLE = 24
FLOATS_PER_NODE = 4


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark; empty lists follow the device."""

    envs: tuple[int, ...] = ()
    """Numbers of environments of ``particles_per_env`` particles."""
    particles: tuple[int, ...] = ()
    """Numbers of particles of a single environment."""
    pairs: tuple[tuple[int, int], ...] = ()
    """Further (environments, particles)."""
    particles_per_env: int = 2500
    substeps: int = 40
    """Of a control step."""
    horizon: int = 1
    """Control steps that are differentiated through; 32 for the memory of a policy gradient."""
    repeats: int = 3
    out: str = "scaling"
    """Name without ending of the JSON and the PNG."""


def block(num_particles: int) -> tuple[mpm.MPMScene, jax.Array]:
    """A block with 8 particles per cell, two cells above the floor, in a box a few cells larger."""
    per_edge = math.ceil(num_particles ** (1 / 3) - 1e-9)
    cells = math.ceil(per_edge / 2)
    spacing = 0.2 / max(cells, 1)
    floor = 3 * spacing
    size = per_edge * spacing / 2
    grid = Grid(shape=(cells + 14, cells + 14, cells + 14), spacing=spacing)
    centre = (0.5 * (cells + 13) * spacing, floor + size / 2 + 0.25 * spacing, 0.5 * (cells + 13) * spacing)
    x = jnp.asarray(fill_box(centre, (size,) * 3, spacing / 2)[:num_particles], jnp.float32)
    far = (cells + 11) * spacing
    material = Material(
        density=jnp.asarray(1e3),
        elasticity=FixedCorotated(youngs_modulus=jnp.asarray(5e3), poissons_ratio=jnp.asarray(0.3)),
    )
    scene = mpm.make_scene(
        grid=grid,
        dt=0.4 * float(mpm.largest_stable_dt(material, grid)),
        material=material,
        particle_volume=jnp.asarray((spacing / 2) ** 3),
        walls=Walls(lower=(Wall(position=floor),) * 3, upper=(Wall(position=far),) * 3),
        max_active_nodes=int(1.3 * int(count_nodes(grid, x))) + 512,
    )
    return scene, x


def measure(args: Args, num_envs: int, num_particles: int, bandwidth: float) -> dict[str, float]:
    """Particle-substeps per second forward and forward + backward, peak bytes of the latter, ratio to the floor."""
    scene, x = block(num_particles)
    poses = mpm.static_poses(args.substeps)
    v = jnp.asarray(np.random.default_rng(0).normal(0.0, 0.1, (num_envs, 1, 3)), jnp.float32)

    def mean_height(v: jax.Array) -> jax.Array:
        def control_step(state: mpm.MPMState, _: None) -> tuple[mpm.MPMState, None]:
            return mpm.step(scene, state, poses), None

        state = mpm.initial_state(x)
        state = state.replace(v=state.v + v)
        return jax.lax.scan(jax.checkpoint(control_step), state, length=args.horizon)[0].x[:, 1].mean()

    work = num_envs * num_particles * args.substeps * args.horizon
    row: dict[str, float] = {"envs": num_envs, "particles": num_particles}
    for name, function in {
        "forward": jax.vmap(mean_height),
        "backward": jax.vmap(jax.value_and_grad(mean_height)),
    }.items():
        compiled = jax.jit(function).lower(v).compile()
        seconds = best(lambda compiled=compiled: compiled(v), args.repeats)
        row[f"{name}_per_s"] = work / seconds
        memory = compiled.memory_analysis()
        if name == "backward" and memory is not None:
            row["bytes"] = memory.temp_size_in_bytes + memory.output_size_in_bytes + memory.argument_size_in_bytes
            row["bytes_per_env"] = row["bytes"] / num_envs
    nodes = int(count_nodes(scene.grid, x))
    moved = 2 * 4 * (FLOATS_PER_PARTICLE * num_particles + FLOATS_PER_NODE * nodes) * num_envs
    row["forward_over_floor"] = (num_envs * num_particles / row["forward_per_s"]) / (moved / bandwidth)
    return row


def best(run: Callable[[], Any], repeats: int) -> float:
    jax.block_until_ready(run())
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - began)
    return min(seconds)


def copy_bandwidth() -> float:
    """Bytes read plus written per second by a large elementwise copy."""
    a, rounds = jnp.ones((64 * 2**20,), jnp.float32), 10
    copy = jax.jit(lambda a: jax.lax.fori_loop(0, rounds, lambda i, a: a + 1.0, a))
    return rounds * 2 * a.nbytes / best(lambda: copy(a), 3)


def sizes(args: Args) -> list[tuple[int, int]]:
    on_cpu = jax.default_backend() == "cpu"
    envs = args.envs or ((1, 4, 16) if on_cpu else (1, 4, 16, 32, 64, 256, 1024))
    particles = args.particles or ((1000, 10_000, 100_000) if on_cpu else (1000, 10_000, 100_000, 1_000_000, 3_000_000))
    pairs = args.pairs or (() if on_cpu else ((32, 30_000),))
    wanted = [*((e, args.particles_per_env) for e in envs), *((1, n) for n in particles), *pairs]
    return list(dict.fromkeys(wanted))


def draw(rows: list[dict[str, float]], args: Args, title: str) -> None:
    matplotlib.use("Agg")
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True)
    by_envs = [r for r in rows if r["particles"] == args.particles_per_env]
    by_particles = [r for r in rows if r["envs"] == 1]
    for panel, chosen, key, label in (
        (panels[0], by_envs, "envs", f"environments of {args.particles_per_env} particles"),
        (panels[1], by_particles, "particles", "particles of one environment"),
    ):
        chosen = sorted(chosen, key=lambda r, key=key: r[key])
        for name, style in (("forward", "o-"), ("backward", "s--")):
            what = name if name == "forward" else "forward + backward"
            panel.loglog([r[key] for r in chosen], [r[f"{name}_per_s"] for r in chosen], style, label=what)
        panel.set_xlabel(label)
        panel.grid(alpha=0.3, which="both")
    panels[0].set_ylabel("particle-substeps per second")
    panels[0].legend(frameon=False)
    figure.suptitle(title)
    figure.savefig(args.out + ".png", dpi=150, bbox_inches="tight")


def main(args: Args) -> None:
    enable_compilation_cache()
    bandwidth = copy_bandwidth()
    device = jax.devices()[0].device_kind
    print(f"{device}: copies {bandwidth / 1e9:.1f} GB/s")
    print(f"{'envs':>6s} {'particles':>10s} {'forward /s':>12s} {'fwd+bwd /s':>12s} {'MB per env':>11s} {'floors':>7s}")
    rows = []
    for num_envs, num_particles in sizes(args):
        try:
            row = measure(args, num_envs, num_particles, bandwidth)
        except Exception as error:  # out of memory: the table goes on
            print(f"{num_envs:6d} {num_particles:10d}  failed: {str(error).splitlines()[0][:80]}", flush=True)
            continue
        rows.append(row)
        print(
            f"{num_envs:6d} {num_particles:10d} {row['forward_per_s']:12.3g} {row['backward_per_s']:12.3g} "
            f"{row.get('bytes_per_env', math.nan) / 1e6:11.1f} {row['forward_over_floor']:7.1f}",
            flush=True,
        )
        with open(args.out + ".json", "w") as file:
            json.dump({"device": device, "copy_bytes_per_s": bandwidth, "rows": rows}, file, indent=2)
    draw(rows, args, f"MLS-MPM on {device}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
