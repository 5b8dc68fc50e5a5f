"""What a run is, apart from its algorithm."""

import dataclasses
from typing import Annotated

from rewax.agents.legal import AT_LEAST_2, Count, Natural, Seed, Share, check_fields


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReportConfig:
    """What a run leaves behind, how often, and when it counts as failed.

    Attributes:
      log_every: iterations between rows of metrics.csv.
      eval_every: iterations between evaluations, 0 for one at the end only.
      eval_at_start: evaluate before the first iteration too.
      num_eval_episodes: episodes of an evaluation.
      checkpoint_every: iterations between checkpoints, 0 for one at the end only; each evaluation is preceded by one.
      keep_checkpoints: number of checkpoints that stay.
      baselines: also evaluate no action and random actions, once, for comparison.
      plots: draw the learning curve and an episode's particles or bodies at the end.
      num_frames: moments of the episode in the latter.
      video: with the plots, also write the episode as a video and as a page for a browser.
      tensorboard: write event files beside the CSV.
      wandb: project of Weights & Biases that gets the numbers too (needs rewax[wandb]); empty for none.
      max_failed_share: share of numerically failed episodes above which the run stops; 1 never stops it.
      failure_window: iterations over which that share is taken.
    """

    log_every: Count = 1
    eval_every: Natural = 20
    eval_at_start: bool = True
    num_eval_episodes: Count = 16
    checkpoint_every: Natural = 10
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
    """A run: how long, from which seed, where, and what it leaves behind.

    Attributes:
      num_iterations: iterations in all, those before a resume among them.
      num_steps: control steps of all environments, after which the run ends instead, with the iteration that reaches
        them; 0: it ends after ``num_iterations``. For algorithms whose iterations differ in steps.
      run_dir: directory of the run.
      seed: everything random follows from it.
      resume: continue the run in ``run_dir`` from its newest checkpoint.
      init_from: directory of a run whose networks, temperature and statistics a new run begins with; empty for none.
      devices: over how many its environments are divided; 0: as many of JAX's as divide them. A checkpoint knows
        nothing of devices.
    """

    num_iterations: Count
    run_dir: str
    seed: Seed = 0
    resume: bool = False
    init_from: str = ""
    devices: Natural = 0
    num_steps: Natural = 0

    def over(self, iteration: int, env_steps: int) -> bool:
        """Whether a run that has done so many iterations and control steps is at its end."""
        return env_steps >= self.num_steps if self.num_steps else iteration >= self.num_iterations
