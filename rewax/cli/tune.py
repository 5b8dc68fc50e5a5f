"""``rewax tune``: search for the hyper-parameters of an algorithm on one task."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from rewax.agents.legal import Count
from rewax.cli.options import Imports, build_env, import_modules, parse
from rewax.cli.train import quiet
from rewax.envs import registry
from rewax.whole_files import replacing

_PROG = "rewax tune"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      env: name of the environment.
      scale: small (made for a CPU) or paper (the constants of the paper, for an accelerator); the default depends on
        the device.
      algo: name of the algorithm.
      imports: module or .py file that registers environments or algorithms.
      trials: total number of trials of the search, including those of other processes and earlier calls.
      seeds: each trial trains once with each of these; use other seeds for final results.
      steps: control steps of each seed; by default those of the preset.
      episodes: number of episodes in each evaluation of each seed, with sampled actions.
      reports: number of evaluations of a trial, the last one at its end. A trial is pruned if its best
        evaluation so far is worse than the median of the completed trials at the same point, from the sixth trial on.
      space: TOML file with the search space; by default the one of the package for this algorithm.
      out: directory of the search, by default tune/<env>-<scale>-<algo>. The same command continues it, and several
        processes can share it.
    """

    env: str = "RollingFlat"
    scale: str | None = None
    algo: str = "sapo"
    imports: Imports = ()
    trials: Count = 30
    seeds: tuple[int, ...] = (1000, 1001)
    steps: Count | None = None
    episodes: Count = 64
    reports: Count = 4
    space: str | None = None
    out: str | None = None


def run(argv: Sequence[str]) -> int:
    """Run the remaining trials of a search, and print the best options.

    Returns:
      Exit code: 0; 1 if no trial was completed; 128 + signal after an interruption.

    Raises:
      ValueError: an error in the input, or optuna is missing; one sentence.
    """
    from rewax.training.storage.cache import enable_compilation_cache
    from rewax.training.tuning.report import as_command, as_toml, best_trial
    from rewax.training.tuning.space import read_space
    from rewax.training.tuning.study import need_optuna, open_study, run_study
    from rewax.training.tuning.trial import Task

    quiet()
    options = parse(Options, argv, prog=_PROG, description="Search for hyper-parameters, with optuna.")
    need_optuna()
    enable_compilation_cache()
    import_modules(options.imports)
    scale, console = options.scale or registry.default_scale(), Console(highlight=False, soft_wrap=True)
    space, env = read_space(options.algo, options.space), build_env(options.env, scale)
    names = ("seeds", "steps", "episodes", "reports")
    shared = {name: getattr(options, name) for name in names}
    task = Task(env=options.env, scale=scale, algo=options.algo, **shared)
    out_dir = Path(options.out or f"tune/{options.env}-{scale}-{options.algo}")
    signum = run_study(task, space, env, out_dir, options.trials, console)
    best = best_trial(open_study(out_dir), space)
    if best is not None:
        steps = task.control_steps(env)
        table = as_toml(task, best.values, steps)
        with replacing(out_dir / "best.toml") as unfinished:
            unfinished.write_text(table)
        console.print(f"best of the trials in {out_dir}: trial {best.number}, mean return {best.mean:.6g}\n")
        console.print(f"{as_command(task, best.values, steps, options.imports)}\n\n{table}", markup=False, end="")
    elif not signum:
        console.print(f"no trial was completed: {out_dir / 'trials.csv'} says why")
    return 128 + signum if signum else int(best is None)


__all__ = ["Options", "run"]
