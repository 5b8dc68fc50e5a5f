"""What a run is, apart from its algorithm."""

import dataclasses


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReportConfig:
    """What a run leaves behind, how often, and when it counts as failed.

    Attributes:
      log_every: iterations between rows of metrics.csv.
      eval_every: iterations between evaluations, 0 for one at the end only.
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

    log_every: int = 1
    eval_every: int = 20
    num_eval_episodes: int = 16
    checkpoint_every: int = 10
    keep_checkpoints: int = 3
    baselines: bool = True
    plots: bool = True
    num_frames: int = 6
    video: bool = True
    tensorboard: bool = True
    wandb: str = ""
    max_failed_share: float = 0.5
    failure_window: int = 20

    def __post_init__(self) -> None:
        if not 0.0 <= self.max_failed_share <= 1.0:
            raise ValueError(f"max_failed_share is {self.max_failed_share}: use a number from 0 to 1")
        for name, least in _LEAST.items():
            value = getattr(self, name, least)
            if value < least:
                raise ValueError(f"{name} is {value}: use {least} or more")


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

    num_iterations: int
    run_dir: str
    seed: int = 0
    resume: bool = False
    init_from: str = ""
    devices: int = 0
    num_steps: int = 0

    def over(self, iteration: int, env_steps: int) -> bool:
        """Whether a run that has done so many iterations and control steps is at its end."""
        return env_steps >= self.num_steps if self.num_steps else iteration >= self.num_iterations


_LEAST = {
    "num_iterations": 1,
    "num_steps": 0,
    "seed": 0,
    "devices": 0,
    "log_every": 1,
    "eval_every": 0,
    "num_eval_episodes": 1,
    "checkpoint_every": 0,
    "keep_checkpoints": 1,
    "num_frames": 2,
    "failure_window": 1,
}
