"""Results of a study: a table of its trials, and the best one as options of ``rewax train`` and of a suite."""

import csv
import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rewax.agents.config import Value
from rewax.training.tuning.space import Space
from rewax.training.tuning.trial import Task
from rewax.whole_files import replacing


class Best(NamedTuple):
    """The best trial: its number, its mean return, and the values of the searched options."""

    number: int
    mean: float
    values: dict[str, Value]


def best_trial(study: Any, space: Space) -> Best | None:
    """The best completed trial; None if there is none."""
    done = [trial for trial in study.get_trials(deepcopy=False) if trial.state.name == "COMPLETE"]
    if not done:
        return None
    best = max(done, key=lambda trial: trial.value)
    return Best(best.number, best.value, _values(best, space))


def write_trials(study: Any, space: Space, out_dir: Path) -> None:
    """Write ``trials.csv``: a row for each trial with its mean return, or the last one before pruning."""
    with replacing(out_dir / "trials.csv") as unfinished, unfinished.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["trial", "state", "mean", "reports", *space, "failure"])
        for trial in study.get_trials(deepcopy=False):
            last = max(trial.intermediate_values, default=0)
            mean = trial.intermediate_values.get(last, "") if trial.value is None else trial.value
            values, failure = _values(trial, space), trial.user_attrs.get("failure", "")
            state = "failed" if failure else trial.state.name.lower()
            writer.writerow([trial.number, state, mean, last, *(values.get(name, "") for name in space), failure])


def as_command(task: Task, values: Mapping[str, Value], steps: int, imports: Sequence[str] = ()) -> str:
    """The command ``rewax train`` with these values and as many control steps. ``imports`` register the task."""
    argv = ["rewax", "train", "--env", task.env, "--scale", task.scale, "--algo", task.algo]
    for module in imports:
        argv += ["--import", module]
    for name, value in values.items():
        flag = f"--{task.algo.replace('_', '-')}.{name.replace('_', '-')}"
        if isinstance(value, bool):
            argv.append(flag if value else flag.replace(".", ".no-"))
        else:
            argv += [flag, *(str(one) for one in (value if isinstance(value, tuple) else (value,)))]
    return shlex.join([*argv, "--steps", str(steps)])


def as_toml(task: Task, values: Mapping[str, Value], steps: int) -> str:
    """The tables ``[options.<algorithm>]`` and ``[steps]`` of a suite with these values."""
    lines = [f"{name} = {json.dumps(list(v) if isinstance(v, tuple) else v)}" for name, v in values.items()]
    return "\n".join([f"[options.{task.algo}]", *lines, "", "[steps]", f"{json.dumps(task.env)} = {steps}"]) + "\n"


def _values(trial: Any, space: Space) -> dict[str, Value]:
    return {name: where.value(trial.params[name]) for name, where in space.items() if name in trial.params}


__all__ = ["Best", "as_command", "as_toml", "best_trial", "write_trials"]
