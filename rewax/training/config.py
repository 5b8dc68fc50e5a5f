"""Options of a run that do not belong to its algorithm."""

import dataclasses
from typing import Annotated

from rewax.agents.legal import AT_LEAST_2, Count, Legal, Natural, NonNegative, Seed, Share, check_fields

MOST_STEPS = 2**31 - 1
_DIRECTORY = Legal("name a directory", lambda v: isinstance(v, str) and bool(v.strip()))


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReportConfig:
    """Which files a run writes, how often, and when the run counts as failed.

    Attributes:
      log_every: iterations between rows of metrics.csv.
      eval_every: iterations between evaluations; 0: evaluate at the end only.
      eval_at_start: evaluate before the first iteration too.
      num_eval_episodes: number of episodes in each evaluation.
      checkpoint_every: iterations between checkpoints; 0: save at the end only. A checkpoint precedes each evaluation.
      checkpoint_seconds: least time between these checkpoints [s]; one that would come earlier is left out.
      keep_checkpoints: number of newest checkpoints that are kept.
      baselines: also evaluate zero actions and random actions once, for comparison.
      plots: at the end draw the learning curve and the particles or bodies of an episode.
      num_frames: number of moments of that episode in one picture.
      video: with ``plots``, also write the episode as a video and as a page for a browser.
      tensorboard: write TensorBoard event files beside the CSV files.
      wandb: Weights & Biases project that receives the metrics too (needs rewax[wandb]); empty: none.
      max_failed_share: share of numerically failed episodes, or of environments without a finite gradient, above which
        the run stops; 1: never stop.
      failure_window: number of last iterations over which these shares are computed.
    """

    log_every: Count = 1
    eval_every: Natural = 20
    eval_at_start: bool = True
    num_eval_episodes: Count = 16
    checkpoint_every: Natural = 10
    checkpoint_seconds: NonNegative = 0.0
    keep_checkpoints: Count = 3
    baselines: bool = True
    plots: bool = True
    num_frames: Annotated[int, AT_LEAST_2] = 6
    video: bool = True
    tensorboard: bool = True
    wandb: str = ""
    max_failed_share: Share = 0.5
    failure_window: Count = 20

    def __post_init__(self) -> None:
        check_fields(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig(ReportConfig):
    """A run: its length, seed, directory and reports.

    ``rewax.training.ReportConfig`` explains the options of its reports: ``eval_every``, ``num_eval_episodes``,
    ``checkpoint_every``, ``plots``, ``video`` and others.

    Attributes:
      num_iterations: total number of iterations, including those before a resume.
      num_steps: total number of control steps of all environments: the run ends with the iteration that reaches it.
        For algorithms whose iterations have different numbers of steps. 0: the run ends after ``num_iterations``.
      run_dir: directory of the run.
      seed: of all random numbers of the run.
      resume: continue the run in ``run_dir`` from its newest checkpoint.
      init_from: directory of another run: the new run starts with its networks, temperature and statistics;
        empty: none.
      devices: number of devices that the environments are sharded over; 0: the largest number of JAX's devices that
        divides the number of environments. Several seeds are sharded instead (``train_seeds``). Checkpoints do not
        depend on it.
    """

    num_iterations: Count
    run_dir: Annotated[str, _DIRECTORY]
    seed: Seed = 0
    resume: bool = False
    init_from: str = ""
    devices: Natural = 0
    num_steps: Natural = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_steps > MOST_STEPS:
            raise ValueError(f"num_steps is {self.num_steps}: give at most {MOST_STEPS}, which a run can count")

    def over(self, iteration: int, env_steps: int) -> bool:
        """Whether a run ends after this many iterations and control steps."""
        return env_steps >= self.num_steps if self.num_steps else iteration >= self.num_iterations
