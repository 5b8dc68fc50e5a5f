"""Suites: tasks, algorithms and seeds of a benchmark, from a TOML file."""

import dataclasses
import tomllib
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from rewax.agents.legal import SEED
from rewax.agents.registry import algorithm
from rewax.envs import registry
from rewax.envs.base import Env

BUILT_IN = ("smoke", "small", "thin", "paper", "paper_stale_mass", "ablations", "ablations_paper", "successors")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Suite:
    """A grid of runs.

    Attributes:
      name: that of the file, without its ending.
      scale: of the tasks, ``small`` or ``paper``.
      tasks, algorithms: registered names.
      seeds: for each pair of task and algorithm.
      steps: total number of control steps, by task; by default that of each algorithm's preset.
      options: options that differ from the presets, by algorithm; ``all`` applies to every algorithm with the option.
      env_options: keyword arguments of ``rewax.make``, by task.
      num_eval_episodes: number of episodes of the final evaluation.
    """

    name: str
    scale: str
    tasks: tuple[str, ...]
    algorithms: tuple[str, ...]
    seeds: tuple[int, ...]
    steps: Mapping[str, int] = dataclasses.field(default_factory=dict)
    options: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    env_options: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    num_eval_episodes: int = 64

    def __post_init__(self) -> None:
        for name in ("tasks", "algorithms", "seeds"):
            value = getattr(self, name)
            if not isinstance(value, (list, tuple)) or not value:
                raise ValueError(f"{name} of the suite {self.name} is {value!r}: give a list with at least one entry")
            object.__setattr__(self, name, tuple(value))
            if name != "seeds" and (odd := [one for one in value if not isinstance(one, str)]):
                raise ValueError(f"{name} of the suite {self.name} have the entry {odd[0]!r}: give names in quotes")
            if name == "seeds" and not all(map(SEED.holds, value)):
                raise ValueError(
                    f"seeds of the suite {self.name} are {list(value)}: give integers from 0 to 4294967295"
                )
            if len(set(value)) < len(value):
                raise ValueError(f"{name} of the suite {self.name} are {list(value)}: name each of them once")
        for name in ("steps", "options", "env_options"):
            if not isinstance(getattr(self, name), Mapping):
                raise ValueError(f"{name} of the suite {self.name} is no table: write [{name}] above its entries")
        for name, value in {"num_eval_episodes": self.num_eval_episodes, **self.steps}.items():
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} of the suite {self.name} is {value!r}: give an integer of at least 1")
        for task in self.tasks:
            registry.check_name(task)
        for name in self.algorithms:
            algorithm(name)
        for table in ("steps", "env_options"):
            if odd := [task for task in getattr(self, table) if task not in self.tasks]:
                raise ValueError(
                    f"{table} of the suite {self.name} name {odd[0]!r}, which is not one of its tasks: remove it"
                )
        for task, options in self.env_options.items():
            if not isinstance(options, Mapping):
                raise ValueError(f"env_options.{task} of the suite {self.name} is no table: write [env_options.{task}]")
            if "scale" in options:
                raise ValueError(f"env_options.{task} of the suite {self.name} gives scale: write it outside, for all")
        for name, changes in self.options.items():
            if not isinstance(changes, Mapping):
                raise ValueError(f"options.{name} of the suite {self.name} is no table: write [options.{name}]")
            if name not in (*self.algorithms, "all"):
                raise ValueError(
                    f"options of the suite {self.name} name {name!r}, which is not one of its algorithms: remove "
                    "them, or write [options.all]"
                )

            if set(self.steps) == set(self.tasks) and "num_iterations" in changes:
                raise ValueError(
                    f"steps and num_iterations of options.{name} of the suite {self.name} both say how long to train: "
                    "give one of them"
                )
        if unknown := sorted(set(self.options.get("all", {})) - _options_of(self.algorithms)):
            raise ValueError(
                f"no algorithm of the suite {self.name} has the option {unknown[0]!r}: correct options.all"
            )

    def only(self, *, tasks: tuple[str, ...], algorithms: tuple[str, ...], seeds: tuple[int, ...]) -> "Suite":
        """The suite with some of its tasks, algorithms and seeds."""
        steps = {task: steps for task, steps in self.steps.items() if task in tasks}
        env_options = {task: options for task, options in self.env_options.items() if task in tasks}
        options = {name: options for name, options in self.options.items() if name in (*algorithms, "all")}
        if "all" in options:  # those of the other algorithms only are no fault
            known = _options_of(algorithms)
            options["all"] = {name: value for name, value in options["all"].items() if name in known}
        changes = {"steps": steps, "env_options": env_options, "options": options}
        return dataclasses.replace(self, tasks=tasks, algorithms=algorithms, seeds=seeds, **changes)

    def env(self, task: str) -> Env:
        """The environment of a task with its options."""
        return registry.make(task, scale=self.scale, **self.env_options.get(task, {}))

    def config(self, task: str, name: str) -> Any:
        """The configuration of an algorithm for a task with its options."""
        config = algorithm(name).preset(task, self.scale)
        known = {field.name for field in dataclasses.fields(config)}
        shared = {key: value for key, value in self.options.get("all", {}).items() if key in known}
        own = dict(self.options.get(name, {}))
        if unknown := sorted(set(own) - known):
            raise ValueError(f"{name} has no option {', '.join(unknown)}: correct the suite {self.name}")
        return dataclasses.replace(config, **{**shared, **own})


def _options_of(algorithms: Iterable[str]) -> set[str]:
    """Names of the options that at least one of the algorithms has."""
    return {field.name for name in algorithms for field in dataclasses.fields(algorithm(name).config_type)}


def read_suite(source: str | Path) -> Suite:
    """A built-in suite by its name, or another one by the path of its file.

    Raises:
      ValueError: there is none, or it has a wrong entry; one sentence.
    """
    if str(source) in BUILT_IN:
        path, name = resources.files("rewax.suites").joinpath(f"{source}.toml"), str(source)
    else:
        path = Path(source)
        if not path.is_file():
            raise ValueError(
                f"there is no suite {str(source)!r}: use {', '.join(BUILT_IN)}, or the path of a TOML file"
            )
        name = path.stem
    try:
        content = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{source} is not TOML ({error}): correct it") from None
    fields = {field.name for field in dataclasses.fields(Suite)} - {"name"}
    if unknown := sorted(set(content) - fields):
        raise ValueError(f"{source} has the unknown entry {unknown[0]!r}: known are {', '.join(sorted(fields))}")
    if missing := [key for key in ("scale", "tasks", "algorithms", "seeds") if key not in content]:
        raise ValueError(f"{source} has no entry {missing[0]!r}: add it")
    return Suite(name=name, **content)
