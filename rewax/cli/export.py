"""``rewax export``: write a trained policy for programs without rewax."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import tyro

from rewax.agents.legal import Natural
from rewax.cli.options import Imports, import_modules, parse
from rewax.cli.train import quiet


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      run_dir: directory of the run, or name of a task with a packaged policy.
      out: folder to write to; by default ``policy`` in the run's directory, or ``<task>-policy`` in the working
        directory.
      scale: of a task given by name; by default what suits the device.
      imports: module or .py file that registers environments or algorithms.
      step: iteration of the checkpoint, the newest by default.
    """

    run_dir: tyro.conf.Positional[str]
    out: str | None = None
    scale: str | None = None
    imports: Imports = ()
    step: Natural | None = None


def run(argv: Sequence[str]) -> int:
    """Export the policy of a run and print the paths of the files.

    Raises:
      ValueError: there is no such run or checkpoint, or the run has no policy network; one sentence.
    """
    from rewax.training.storage.export import export_policy
    from rewax.training.storage.policies import is_policy, open_run

    quiet()
    options = parse(Options, argv, prog="rewax export", description="Write a trained policy as StableHLO and NumPy.")
    import_modules(options.imports)
    saved = open_run(options.run_dir, step=options.step, scale=options.scale)
    beside = Path(f"{options.run_dir}-policy") if is_policy(options.run_dir) else Path(options.run_dir) / "policy"
    for path in export_policy(saved, beside if options.out is None else options.out):
        print(f"wrote {path}")
    return 0


__all__ = ["Options", "run"]
