"""One trial: an algorithm with given options is trained from several seeds and evaluated in between."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.console import Console

from rewax.agents.config import Value, steps_in
from rewax.agents.legal import SEED
from rewax.agents.registry import algorithm, build_agent
from rewax.envs.base import Env
from rewax.training.config import ReportConfig
from rewax.training.evaluation.episodes import make_evaluate
from rewax.training.loop.compilation import compile_train_step
from rewax.training.loop.failure import FailureWatch, FiniteCheck

_EVALUATION_STREAM = 0x7EED  # folded into the seed: evaluation and training draw different random numbers


class Failed(Exception):
    """The trial failed: illegal options or non-finite numbers. The message says why."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Task:
    """Description of the training in every trial of a study.

    Attributes:
      env: name of the environment.
      scale: ``small`` or ``paper``.
      algo: name of the algorithm.
      seeds: one training each; the objective is the mean of their returns.
      steps: control steps of each seed; None: those of the preset.
      episodes: number of episodes in each evaluation of each seed.
      reports: number of evaluations, the last one at the end of training.
    """

    env: str
    scale: str
    algo: str
    seeds: tuple[int, ...] = (1000, 1001)
    steps: int | None = None
    episodes: int = 64
    reports: int = 4

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) < len(self.seeds) or not all(map(SEED.holds, self.seeds)):
            raise ValueError(f"seeds are {list(self.seeds)}: give integers from 0 to 4294967295, each of them once")
        for name in ("steps", "episodes", "reports"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} is {value}: use 1 or more")

    def config(self, env: Env, values: Mapping[str, Value]) -> Any:
        """The preset with these values, and as many iterations as ``steps`` takes.

        Raises:
          ValueError: illegal options.
        """
        config = dataclasses.replace(self._preset, **values)
        per_iteration = config.num_envs * steps_in(config, env)
        return dataclasses.replace(config, num_iterations=math.ceil(self.control_steps(env) / per_iteration))

    def control_steps(self, env: Env) -> int:
        """Control steps of each seed, whatever the options."""
        preset = self._preset
        return self.steps or preset.num_iterations * preset.num_envs * steps_in(preset, env)

    @property
    def _preset(self) -> Any:
        return algorithm(self.algo).preset(self.env, self.scale)


class Report(NamedTuple):
    """Mean return over the episodes of all seeds, with sampled actions, after a part of the training."""

    number: int
    mean: float


def run_trial(
    task: Task, env: Env, values: Mapping[str, Value], console: Console, stopped: Callable[[], bool]
) -> Iterator[Report]:
    """Train, and report ``task.reports`` times.

    Args:
      task: what to train.
      env: its environment, unbatched.
      values: of the searched options.
      console: to print to.
      stopped: whether to end early, without a further report.

    Raises:
      Failed: illegal options, too many failed episodes, or non-finite numbers.
    """
    try:
        config = task.config(env, values)
        agent = build_agent(task.algo, env, config)
    except ValueError as error:
        raise Failed(str(error)) from None
    seeds = [_Seed(env, agent, seed) for seed in task.seeds]
    train_step = compile_train_step(agent, seeds[0].state, console)
    evaluate = make_evaluate(env, agent.policy, task.episodes)
    steps = config.num_iterations * config.num_envs * steps_in(config, env)
    for number in range(1, task.reports + 1):
        for seed in seeds:
            while seed.env_steps < steps * number / task.reports:
                if stopped():
                    return
                seed.advance(train_step)
        found = [evaluate(seed.state, seed.key) for seed in seeds]
        for seed, evaluation in zip(seeds, found, strict=True):
            seed.check_failures(int(evaluation["failed"]), task.episodes)
        means = [float(evaluation["mean"]) for evaluation in found]
        if not np.all(np.isfinite(means)):
            raise Failed(f"the mean returns are {means}")
        yield Report(number, float(np.mean(means)))


class _Seed:
    """The training of one seed."""

    def __init__(self, env: Env, agent: Any, seed: int) -> None:
        self.state = jax.jit(agent.init)(jax.random.key(seed))
        self.key = jax.random.fold_in(jax.random.key(seed), _EVALUATION_STREAM)
        num_envs = getattr(agent.config, "num_envs", 0)
        self._watch, self._finite = FailureWatch(env, ReportConfig(), num_envs), FiniteCheck(self.state)
        self.env_steps = 0

    def advance(self, train_step: Any) -> None:
        """One iteration.

        Raises:
          Failed: too many episodes failed, or a learnt parameter is not finite.
        """
        self.state, metrics = train_step(self.state)
        metrics, before, self.env_steps = jax.device_get(metrics), self.env_steps, int(self.state.env_steps)
        iteration = int(self.state.iteration)
        self._watch.add(iteration, self.env_steps - before, metrics)
        if bad := self._finite.first_bad(self.state):
            raise Failed(f"iteration {iteration} made {bad} infinite or NaN")
        if reason := self._watch.reason():
            raise Failed(reason)

    def check_failures(self, failed: int, episodes: int) -> None:
        """Before a report, which short runs reach before the watch has seen enough iterations to judge.

        Args:
          failed, episodes: of the evaluation.

        Raises:
          Failed: too many episodes failed in the last iterations or in the evaluation.
        """
        if reason := self._watch.reason(final=True):
            raise Failed(reason)
        if failed > ReportConfig().max_failed_share * episodes:
            raise Failed(f"{failed} of {episodes} evaluated episodes failed numerically")


__all__ = ["Failed", "Report", "Task", "run_trial"]
