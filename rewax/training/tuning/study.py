"""A study: the trials of a search, in a journal that several processes can share and continue."""

import importlib
import importlib.util
import json
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from rewax.agents.registry import algorithm
from rewax.envs.base import Env
from rewax.training.loop.interrupt import Stop, graceful_stop
from rewax.training.loop.progress import say
from rewax.training.storage.description import plain
from rewax.training.storage.run_directory import InUse, hold
from rewax.training.tuning.report import write_trials
from rewax.training.tuning.space import Space, preset_values
from rewax.training.tuning.trial import Failed, Task, run_trial
from rewax.whole_files import replacing

if TYPE_CHECKING:
    import optuna

_STARTUP_TRIALS = 5
"""Number of trials before pruning begins and before the sampler uses earlier results."""


def need_optuna() -> None:
    """Check that the package is there.

    Raises:
      ValueError: it is not.
    """
    if importlib.util.find_spec("optuna") is None:
        raise ValueError("rewax tune needs optuna: pip install 'rewax[tune]'")


def run_study(task: Task, space: Space, env: Env, out_dir: str | Path, num_trials: int, console: Console) -> int:
    """Do trials until the study has ``num_trials``, including those of other processes.

    The first trial is the preset. An interrupted trial is repeated. A failed trial ranks last. Processes know each
    other's running trials by locks of files: on a file system without ``flock``, only one process may work on a study.

    Args:
      task: what a trial trains.
      space: the search space.
      env: of the task.
      out_dir: holds ``journal.log``, ``study.json`` and ``trials.csv``.
      num_trials: total number of trials of the study.
      console: to print to.

    Returns:
      The signal that stopped it, 0 if all trials are done.

    Raises:
      ValueError: optuna is missing, or ``out_dir`` cannot be used or holds another search.
    """
    out_dir = Path(out_dir)
    with graceful_stop(lambda _: say(console, "stopping: the same command continues")) as stop:
        with _turn(out_dir):
            _claim(task, space, out_dir)
            study = open_study(out_dir)
            if not study.trials:
                preset = algorithm(task.algo).preset(task.env, task.scale)
                study.enqueue_trial(preset_values(space, preset), skip_if_exists=True)
        while not stop.requested:
            with ExitStack() as held:
                with _turn(out_dir):
                    trial = _next_trial(study, out_dir, num_trials, held)
                if trial is None:
                    break
                _do(study, trial, task, space, env, console, stop)
            with _turn(out_dir):
                write_trials(study, space, out_dir)
        return stop.signum


def open_study(out_dir: Path) -> "optuna.Study":
    """The study of a directory; created if there is none."""
    need_optuna()
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna.create_study(
        study_name="rewax",
        storage=JournalStorage(JournalFileBackend(str(out_dir / "journal.log"))),
        direction="maximize",
        load_if_exists=True,
        sampler=optuna.samplers.TPESampler(n_startup_trials=_STARTUP_TRIALS, constant_liar=True),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=_STARTUP_TRIALS),
    )


@contextmanager
def _turn(out_dir: Path) -> Iterator[None]:
    """Within the block the other processes wait."""
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(hold(out_dir))
                break
            except InUse:
                time.sleep(0.05)
        yield


def _claim(task: Task, space: Space, out_dir: Path) -> None:
    """Write task and space to ``study.json``, or compare with it: other trials need another study."""
    path = out_dir / "study.json"
    content = plain({"task": task, "space": {name: dict(r._asdict()) for name, r in space.items()}})
    ours = _entries(json.loads(json.dumps(content)))
    try:
        stored = _entries(json.loads(path.read_text())) if path.is_file() else ours
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path} cannot be read ({error}): choose another directory (--out)") from None
    if stored != ours:
        odd = next(name for name in {**ours, **stored} if stored.get(name) != ours.get(name))
        raise ValueError(f"{out_dir} holds a search with other {odd}: choose another directory (--out)")
    if not path.is_file():
        with replacing(path) as unfinished:
            unfinished.write_text(json.dumps(content, indent=1) + "\n")


def _entries(content: Mapping[str, Any]) -> dict[str, Any]:
    return {**content["task"], "space": content["space"]}


def _next_trial(study: Any, out_dir: Path, num_trials: int, held: ExitStack) -> Any:
    """The next trial, with its directory held; None if enough trials are done or running."""
    from optuna.trial import TrialState

    begun = 0
    for old in study.get_trials(deepcopy=False):
        if old.state == TrialState.RUNNING and not _is_held(out_dir, old.number):  # its process has ended
            study.tell(old.number, state=TrialState.FAIL)
            # One that was cut off before its first suggestion has no parameters yet, but those it was enqueued with.
            study.enqueue_trial({**old.system_attrs.get("fixed_params", {}), **old.params})
        elif old.state in (TrialState.COMPLETE, TrialState.PRUNED, TrialState.RUNNING):
            begun += 1
    if begun >= num_trials:
        return None
    trial = study.ask()
    held.enter_context(hold(_folder(out_dir, trial.number)))
    return trial


def _folder(out_dir: Path, number: int) -> Path:
    return out_dir / "trials" / str(number)


def _is_held(out_dir: Path, number: int) -> bool:
    try:
        with hold(_folder(out_dir, number)):
            return False
    except InUse:
        return True


def _do(study: Any, trial: Any, task: Task, space: Space, env: Env, console: Console, stop: Stop) -> None:
    """Train one trial and record its result."""
    from optuna.trial import TrialState

    values = {name: _suggest(trial, name, where) for name, where in space.items()}
    say(console, f"trial {trial.number}: " + ", ".join(f"{name} {_short(value)}" for name, value in values.items()))
    number, mean = 0, math.nan
    try:
        for number, mean in run_trial(task, env, values, console, lambda: stop.requested):
            trial.report(mean, number)
            if number < task.reports and trial.should_prune():
                say(console, f"trial {trial.number}: mean return {mean:.6g} after {number}/{task.reports}, pruned")
                study.tell(trial, state=TrialState.PRUNED)
                return
    except Failed as failed:
        _fail(study, trial, str(failed), console)
        return
    except Exception as error:  # such as out of memory, or values that fit no program: other trials may succeed
        _fail(study, trial, f"{type(error).__name__}: {' '.join(str(error).split())[:200]}", console)
        if trial.number == 0 and isinstance(error, ValueError):  # the preset: a fault of the task
            raise
        return
    if number < task.reports:
        return  # stopped: the trial stays running in the journal, and the process that continues the study repeats it
    study.tell(trial, mean)
    say(console, f"trial {trial.number}: mean return {mean:.6g}, best {study.best_value:.6g}")


def _fail(study: Any, trial: Any, why: str, console: Console) -> None:
    """Record a failed trial: the sampler ranks it behind completed trials."""
    trial.set_user_attr("failure", why)
    say(console, f"trial {trial.number} failed: {why}")
    study.tell(trial, state=importlib.import_module("optuna.trial").TrialState.PRUNED)


def _suggest(trial: Any, name: str, where: Any) -> Any:
    if where.choices:
        return where.value(trial.suggest_categorical(name, list(range(len(where.choices)))))
    suggest = trial.suggest_int if where.integers else trial.suggest_float
    return suggest(name, where.low, where.high, log=where.log)


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


__all__ = ["need_optuna", "open_study", "run_study"]
