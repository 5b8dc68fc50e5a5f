"""A gradient audit: is the derivative that a simulator gives the derivative of what it computes?

Five questions (six scenes, ``audit_scenes``) to rewax and to other differentiable simulators, each in a process of its
own: the share of entries that are silently zero or not finite, the error against central differences of the simulator's
own forward function, seconds and memory (``audit_protocol``). What is not installed is a row too.

    python -m venv opponents && opponents/bin/pip install warp-lang taichi newton
    python -m venv genesis && genesis/bin/pip install torch genesis-world
    python benchmarks/gradient_audit --python warp=opponents/bin/python taichi=opponents/bin/python \\
        newton=opponents/bin/python genesis=genesis/bin/python
"""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import tyro
from audit_protocol import Row
from audit_scenes import SCENES
from audit_table import markdown, read, write

HERE = Path(__file__).resolve().parent
SIMULATORS = {
    "rewax": ("rewax", "rewax (MuJoCo's law)"),
    "warp": ("Warp",),
    "taichi": ("Taichi", "Taichi (own SVD adjoint)"),
    "newton": ("Newton (SemiImplicit)", "Newton (Featherstone)"),
    "mjx": ("MJX, 1 iteration", "MJX, 20 iterations", "MJX, forward mode"),
    "genesis": ("Genesis",),
}
"""Modules ``with_NAME`` and the variants that each has."""
ONLY = {
    "rewax (MuJoCo's law)": ("slide-rigid", "foot"),
    "Taichi (own SVD adjoint)": ("press",),
    "MJX, 20 iterations": ("slide-rigid", "foot"),
    "MJX, forward mode": ("slide-rigid", "foot"),
}
"""Variants that exist for some scenes only; they have no rows elsewhere."""


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the audit."""

    simulators: tuple[str, ...] = tuple(SIMULATORS)
    scenes: tuple[str, ...] = tuple(SCENES)
    python: tuple[str, ...] = ()
    """Interpreters of simulators that live elsewhere: ``warp=/path/to/python``."""
    starts: int = 8
    timeout: float = 900.0
    """Of one simulator and scene [s]."""
    out: Path = Path("gradient_audit")
    """Folder of the table; rows that lie there stay unless this run has them too."""


def run(interpreter: str, name: str, variant: str, scene: str, args: Args) -> Row:
    """The row of a process; a process that dies or hangs has one too."""
    command = [interpreter, str(HERE / "audit_worker.py"), f"with_{name}", variant, scene, str(args.starts)]
    failed = Row(simulator=variant, scene=scene, status="failed")
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=args.timeout)
    except subprocess.TimeoutExpired:
        return dataclasses.replace(failed, note=f"no answer within {args.timeout:g} s")
    except FileNotFoundError:
        return dataclasses.replace(failed, status="not installed", note=f"no interpreter {interpreter}")
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if not lines:
        last = (done.stderr.strip().splitlines() or [""])[-1]
        return dataclasses.replace(failed, note=f"exit code {done.returncode}: {last[:200]}")
    return Row(**json.loads(lines[-1]))


def main(args: Args) -> None:
    known = dict(entry.split("=", 1) for entry in args.python)
    rows = read(args.out)
    for scene in args.scenes:
        for name in args.simulators:
            for variant in SIMULATORS[name]:
                if scene in ONLY.get(variant, SCENES):
                    new = run(known.get(name, sys.executable), name, variant, scene, args)
                    print(new, file=sys.stderr, flush=True)
                    rows = [row for row in rows if (row.simulator, row.scene) != (variant, scene)] + [new]
                    write(rows, args.out)
    print(markdown(rows))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
