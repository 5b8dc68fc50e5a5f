"""How long kernels run on an accelerator: number, time and gaps of one program, and the kernels that take most of it.

    python benchmarks/gpu_profile.py --what backward --task RollingFlat --num-envs 32
    python benchmarks/gpu_profile.py --what train_step --task AntRun --top 40

``gpu_aot.py`` counts the kernels of the same programs without a GPU and estimates their time; this measures it. A line
for each kernel: its share of the time of all kernels, how often it ran, its mean time, and the operation in rewax from
which XLA made it. ``busy`` is the time of all kernels over the time of the whole program without the profiler.
"""

import collections
import dataclasses
import glob
import re
import tempfile
from typing import Any

import jax
import tyro
from speed import program, timed

import rewax
from rewax.training import enable_compilation_cache


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    what: str = "backward"
    """forward, backward or train_step."""
    task: str = "RollingFlat"
    scale: str = "paper"
    num_envs: int = 32
    """For forward and backward; a train step has the preset's number."""
    top: int = 20


def kernels(run: Any) -> dict[str, list[float]]:
    """Nanoseconds of each run of each kernel during one run of a program, by the operation's name."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            run()
        (path,) = glob.glob(folder + "/**/*.xplane.pb", recursive=True)
        data = jax.profiler.ProfileData.from_file(path)
    on_gpu = jax.default_backend() != "cpu"
    found: dict[str, list[float]] = collections.defaultdict(list)
    for plane in data.planes:
        if on_gpu and not plane.name.startswith("/device:"):
            continue
        for line in plane.lines:
            if on_gpu and not line.name.startswith("Stream"):  # the other lines repeat the same times by operation
                continue
            for event in line.events:
                found[str(dict(event.stats).get("hlo_op", event.name))].append(event.duration_ns)
    return found


def origins(text: str) -> dict[str, str]:
    """The last parts of the operation's name in Python, by name in the compiled program."""
    paths = re.findall(r'%?([\w.\-]+) = .*?metadata=\{op_name="([^"]*)"', text)
    return {name: "/".join(path.split("/")[-3:]) for name, path in paths}


def main(args: Args) -> None:
    enable_compilation_cache()
    env: Any = rewax.make(args.task, scale=args.scale)
    compiled, run = program(args.what, env, args.task, args.scale, args.num_envs)
    run()
    wall = min(timed(run) for _ in range(3))
    found = kernels(run)
    total = sum(map(sum, found.values())) / 1e9
    count = sum(map(len, found.values()))
    print(f"{args.what} of {args.task} {args.scale}, jax {jax.__version__}, {jax.devices()[0].device_kind}")
    print(
        f"{1e3 * wall:.2f} ms; {count} kernels and copies, {1e6 * total / max(count, 1):.2f} us on average, "
        f"{1e6 * wall / max(count, 1):.2f} us apart, busy {total / wall:.0%}"
    )
    names = origins(compiled.as_text())
    print(f"{'share':>6s} {'times':>8s} {'mean us':>9s}  operation")
    for name, times in sorted(found.items(), key=lambda item: -sum(item[1]))[: args.top]:
        share, mean = sum(times) / 1e9 / total, sum(times) / len(times) / 1e3
        print(f"{share:6.1%} {len(times):8d} {mean:9.2f}  {name[:44]:44s} {names.get(name, '')[:70]}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
