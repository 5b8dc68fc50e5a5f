"""How long imports take: processor seconds of a new process, best of several, less those of ``import jax``.

python benchmarks/imports.py
"""

import dataclasses
import resource
import subprocess
import sys

import tyro

STATEMENTS = (
    "import rewax",
    "import rewax; [getattr(rewax, name) for name in rewax.__all__]",
    "from rewax.physics import mpm, shapes, tets, coupling",
    "from rewax.physics import rigid",
    "from rewax.agents.sapo import make_sapo",
    "from rewax.training import train",
    "import rewax.viz.plots",
    "import rewax.cli.main",
)
LIMIT = 0.5
"""Most that the first two may take beyond jax [s]."""


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    repeats: int = 7
    """The best of so many counts."""


def seconds(statement: str, repeats: int) -> float:
    """Processor time of a new process that runs a statement [s]; other programs on the machine hardly change it."""
    taken = []
    for _ in range(repeats):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-c", statement], check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        taken.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(taken)


def main(args: Args) -> int:
    """Prints a line for each import; exit code 1 if one of the first two is beyond the limit."""
    bare, jax = seconds("pass", args.repeats), seconds("import jax", args.repeats)
    print(f"{'import jax':62s} {jax - bare:6.2f} s")
    beyond = [seconds(statement, args.repeats) - jax for statement in STATEMENTS]
    for statement, more in zip(STATEMENTS, beyond, strict=True):
        print(f"{statement:62s} {more:+6.2f} s beyond jax")
    return int(max(beyond[:2]) > LIMIT)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args, description=__doc__)))
