"""``rewax bench``: run a suite of tasks, algorithms and seeds, and write one table."""

import dataclasses
from collections.abc import Sequence

import tyro
from rich.console import Console

from rewax.agents.legal import Natural
from rewax.cli.options import Imports, import_modules, parse
from rewax.cli.train import cores_as_devices, keep_freed_memory, quiet


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      suite: smoke, small, thin, paper, paper_stale_mass, ablations, ablations_paper, successors, or the path
        of a TOML file.
      imports: module or .py file that registers environments or algorithms.
      out: directory of the results, by default bench/<suite>; an interrupted benchmark continues there.
      tasks: only these of the suite's tasks.
      algorithms: only these of the suite's algorithms.
      seeds: only these of the suite's seeds.
      devices: number of devices (on a CPU: cores) that the environments are sharded over; 0: the largest number that
        divides the number of environments. Several benchmarks of one core each, run at the same time, finish more
        runs in an hour than one benchmark on all cores.
    """

    suite: tyro.conf.Positional[str]
    imports: Imports = ()
    out: str | None = None
    tasks: tuple[str, ...] = ()
    algorithms: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()
    devices: Natural = 0


def run(argv: Sequence[str]) -> int:
    """Run what is missing in a suite, and write its results.

    Returns:
      Exit code: 0; 1 if one of the chosen runs has failed; 128 + signal after an interruption.

    Raises:
      ValueError: the suite has a wrong entry; one sentence.
    """
    from rewax.training.storage.cache import enable_compilation_cache
    from rewax.training.suites.runs import any_failed, run_suite
    from rewax.training.suites.suite import read_suite

    quiet()
    options = parse(Options, argv, prog="rewax bench", description="Compare algorithms on tasks.")
    cores_as_devices(options.devices)
    keep_freed_memory()
    enable_compilation_cache()
    modules = import_modules(options.imports)
    suite = read_suite(options.suite)
    for name in ("tasks", "algorithms", "seeds"):
        wanted, known = getattr(options, name), getattr(suite, name)
        if odd := [item for item in wanted if item not in known]:
            raise ValueError(f"{odd[0]} is not one of the {name} of suite {suite.name}: {', '.join(map(str, known))}")
    chosen = {name: getattr(options, name) or getattr(suite, name) for name in ("tasks", "algorithms", "seeds")}
    out = options.out or f"bench/{suite.name}"
    part = suite.only(**chosen)
    signum = run_suite(suite, out, Console(highlight=False), part=part, devices=options.devices, imports=modules)
    return 128 + signum if signum else int(any_failed(suite, part, out))


__all__ = ["Options", "run"]
