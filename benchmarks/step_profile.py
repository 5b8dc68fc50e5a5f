"""Where an env step's time goes, as a picture: the compiled program's operations, summed by part of the substep.

    python benchmarks/step_profile.py --task RollingFlat --scale paper --out docs/pictures/profile_cpu.png

Operations run side by side on several cores, so times are shares of the sum of all operations, not of the wall clock.
"""

import collections
import dataclasses
import glob
import re
import tempfile
from typing import Any

import jax
import matplotlib
import matplotlib.pyplot as plt
import tyro

import rewax
from rewax.training import enable_compilation_cache

PARTS = ("law", "particle_to_grid", "grid", "grid_to_particle", "update")
"""Named scopes of a substep; everything else is 'rest': the list of nodes, stacking of particles, the task itself."""
CONTAINERS = ("while", "call", "conditional")
"""Operations whose time is that of others inside them."""


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    task: str = "RollingFlat"
    scale: str = "paper"
    num_envs: int = 1
    repeats: int = 5
    out: str = "profile.png"


def programs(args: Args) -> dict[str, tuple[Any, tuple]]:
    """The compiled env step, alone and with its gradient by the action; the state is one with contact."""
    env = rewax.make(args.task, scale=args.scale)
    keys = jax.random.split(jax.random.key(0), args.num_envs)
    state = jax.jit(jax.vmap(env.reset))(keys)
    actions = jax.vmap(lambda key: jax.random.uniform(key, env.action_spec.shape, minval=-1.0, maxval=1.0))(keys)

    def step(state, action):
        new = jax.vmap(env.step)(state, action)
        return new.reward.sum(), new

    backward = jax.value_and_grad(lambda s, a: step(s, a)[0], argnums=1)
    return {
        "forward": (jax.jit(step).lower(state, actions).compile(), (state, actions)),
        "forward + backward": (jax.jit(backward).lower(state, actions).compile(), (state, actions)),
    }


def parts_of(compiled: Any) -> dict[str, str]:
    """Part of the substep to which each operation of a compiled program belongs."""
    found = {}
    for name, path in re.findall(r'%?([\w.\-]+) = .*?metadata=\{op_name="([^"]*)"', compiled.as_text()):
        scopes = [s for s in re.split(r"[/()]", path) if s in PARTS]
        part = scopes[-1] if scopes else "rest"
        found[name] = f"{part}, backward" if "transpose" in path or "_cotangent" in path else part
    return found


def durations(compiled: Any, inputs: tuple, repeats: int) -> collections.Counter[str]:
    """Nanoseconds of every operation in one run, by name."""
    jax.block_until_ready(compiled(*inputs))
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            for _ in range(repeats):
                jax.block_until_ready(compiled(*inputs))
        (path,) = glob.glob(folder + "/**/*.xplane.pb", recursive=True)
        data = jax.profiler.ProfileData.from_file(path)
        total: collections.Counter[str] = collections.Counter()
        for plane in data.planes:
            for line in plane.lines:
                for event in line.events:
                    stats = dict(event.stats)
                    total[str(stats.get("hlo_op", event.name))] += event.duration_ns / repeats
    return total


def main(args: Args) -> None:
    enable_compilation_cache()
    matplotlib.use("Agg")
    figure, axes = plt.subplots(figsize=(8, 3.2))
    device = jax.devices()[0].device_kind
    for row, (what, (compiled, inputs)) in enumerate(programs(args).items()):
        parts = parts_of(compiled)
        sums: collections.Counter[str] = collections.Counter()
        for name, ns in durations(compiled, inputs, args.repeats).items():
            if name in parts and not name.startswith(CONTAINERS):
                sums[parts[name]] += ns
        whole, left = sum(sums.values()), 0.0
        print(what)
        for index, part in enumerate((*PARTS, "rest")):
            for suffix, alpha in (("", 1.0), (", backward", 0.55)):
                share = sums[part + suffix] / whole
                label = part if row == 0 and not suffix else None
                axes.barh(row, share, left=left, color=f"C{index}", alpha=alpha, edgecolor="white", label=label)
                if share > 0.035:
                    axes.text(left + share / 2, row, f"{share:.0%}", ha="center", va="center", fontsize=8)
                if share:
                    print(f"  {part + suffix:28s} {share:6.1%}")
                left += share
    axes.set_yticks([0, 1], ["forward", "forward\n+ backward"])
    axes.set_xlim(0, 1)
    axes.set_xlabel("share of the time of all operations (paler: backward)")
    axes.set_title(f"{args.task} {args.scale}, {args.num_envs} env on {device}")
    axes.legend(ncols=6, loc="upper center", bbox_to_anchor=(0.5, -0.25), frameon=False, fontsize=8)
    figure.savefig(args.out, dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
