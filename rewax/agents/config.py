"""Hyper-parameters that the actor-critic algorithms share, and their checks."""

import dataclasses
import math
from typing import Any, Literal

from rewax.agents.rollout import Differentiation


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActorCriticConfig:
    """Hyper-parameters; the defaults are the paper's for the deformable tasks.

    Attributes:
      num_envs: environments side by side.
      horizon: control steps per iteration and environment.
      num_iterations: iterations over which the learning rates fall linearly to ``final_learning_rate``.
      discount: gamma [-].
      td_lambda: lambda of the critics' targets [-].
      actor_learning_rate, critic_learning_rate, final_learning_rate: of AdamW.
      adam_b1, adam_b2, weight_decay: of all optimizers.
      max_grad_norm: global norm to which each optimizer's gradient is clipped.
      critic_passes, critic_minibatches: how often each iteration's data is used, in how many contiguous parts.
      critic_chunk: samples of a minibatch that are differentiated at a time, their gradients added up; the update is
        the same but for rounding. None: all on an accelerator, as many as fit its cache on a CPU.
      num_critics: independent value heads; the actor sees their mean, targets use their minimum.
      actor_widths, critic_widths, point_widths, point_features, vector_features: network sizes.
      activation: ``silu``, ``elu``, ``relu`` or ``tanh``.
      log_std_range: clamp of the log standard deviation.
      initial_log_std: added to the log standard deviation's bias at the start; 0 gives sigma near 1.
      normalize_observations: running normalisation of vector observations.
      observation_clip: normalised observations stay between minus and plus this, with zero gradient beyond; None: no
        limit. The default is out of reach but for a task's first rollout and for numbers gone astray.
      stagger_episodes: start environments at random points of their time limit, so that they do not reset together.
      differentiate: how the rollout is differentiated, see ``rewax.agents.rollout``.
    """

    num_envs: int = 32
    horizon: int = 32
    num_iterations: int = 4000
    discount: float = 0.99
    td_lambda: float = 0.95
    actor_learning_rate: float = 2e-3
    critic_learning_rate: float = 5e-4
    final_learning_rate: float = 1e-5
    adam_b1: float = 0.7
    adam_b2: float = 0.95
    weight_decay: float = 0.01
    max_grad_norm: float = 0.5
    critic_passes: int = 16
    critic_minibatches: int = 4
    critic_chunk: int | None = None
    num_critics: int = 2
    actor_widths: tuple[int, ...] = (512, 256)
    critic_widths: tuple[int, ...] = (256, 256)
    point_widths: tuple[int, ...] = (64, 128, 256)
    point_features: int = 64
    vector_features: int = 128
    activation: Literal["silu", "elu", "relu", "tanh"] = "silu"
    log_std_range: tuple[float, float] = (-5.0, 2.0)
    initial_log_std: float = 0.0
    normalize_observations: bool = True
    observation_clip: float | None = 100.0
    stagger_episodes: bool = False
    differentiate: Differentiation = "checkpointed"

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # a list of widths is as good; configurations are hashed
            value = getattr(self, field.name)
            if isinstance(value, list):
                object.__setattr__(self, field.name, tuple(value))
        counts = ("num_envs", "horizon", "num_iterations", "critic_passes", "critic_minibatches", "num_critics")
        for name in counts:
            check_count(name, getattr(self, name))
        for name in ("discount", "td_lambda"):
            check_share(name, getattr(self, name))
        for name in ("actor_learning_rate", "critic_learning_rate", "max_grad_norm"):
            check_positive(name, getattr(self, name))
        if self.observation_clip is not None:
            check_positive("observation_clip", self.observation_clip, "a positive number, or None for no limit")
        if (self.num_envs * self.horizon) % self.critic_minibatches:
            raise ValueError(
                f"critic_minibatches is {self.critic_minibatches}, which does not divide num_envs * horizon = "
                f"{self.num_envs * self.horizon}: choose a divisor"
            )
        if self.critic_chunk is not None and (self.critic_chunk < 1 or self.minibatch % self.critic_chunk):
            raise ValueError(
                f"critic_chunk is {self.critic_chunk}, which does not divide a minibatch of {self.minibatch} samples "
                "(num_envs * horizon / critic_minibatches): choose a divisor, or None"
            )

    @property
    def minibatch(self) -> int:
        """Samples in one minibatch of the critics."""
        return self.num_envs * self.horizon // self.critic_minibatches


def check_count(name: str, value: Any) -> None:
    """Raises ValueError unless ``value`` is a whole number of at least 1."""
    if not isinstance(value, int) or value < 1:
        raise ValueError(f"{name} is {value}: give a whole number of at least 1")


def check_share(name: str, value: float) -> None:
    """Raises ValueError unless ``value`` lies between 0 and 1."""
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"{name} is {value}: give a number between 0 and 1")


def check_positive(name: str, value: float, wanted: str = "a positive number") -> None:
    """Raises ValueError unless ``value`` is finite and above 0."""
    if not (value > 0.0 and math.isfinite(value)):
        raise ValueError(f"{name} is {value}: give {wanted}")
