"""Hyper-parameters that algorithms share.

Groups of options have no base class and no default of another group's option: ``RunConfig``, ``PolicyOptions``,
``CriticOptions``, ``GradientOptions``, ``FittingOptions``. Three classes combine them, and an algorithm adds its own
options and defaults to one of these. The legal values of an option stand in its type.
"""

import dataclasses
from typing import Annotated, ClassVar, Literal, TypeAlias, TypedDict

from rewax.agents.legal import (
    COUNT,
    POSITIVE,
    Count,
    Decay,
    Interval,
    Natural,
    NonNegative,
    Positive,
    Share,
    Widths,
    check_fields,
)
from rewax.agents.rollout import Differentiation
from rewax.envs.base import Env

Value: TypeAlias = bool | int | float | str | tuple[int | float, ...] | None
"""What an option can be."""
Optimizer = Literal["adamw", "adam"]
Combination = Literal["mean", "min"]
Activation = Literal["silu", "elu", "relu", "tanh"]


Gain = Annotated[float | None, POSITIVE.or_none("give a positive number, or None for initial_gain")]
Limit = Annotated[float | None, POSITIVE.or_none("give a positive number, or None for no limit")]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunConfig:
    """What every algorithm has.

    Attributes:
      num_envs: environments side by side.
      horizon: control steps per iteration and environment; 0, where an algorithm allows it: whole episodes, each
        iteration from new initial states.
      num_iterations: iterations over which learning rates fall.
      quick_compile: on a CPU, compile with XLA's older generator of code: a first-order algorithm's train step in two
        thirds to nine tenths of the time, whose iterations take 1 to 6 % longer. For short runs. Since
        jax 0.12 XLA has one generator, and this changes nothing.
    """

    least_horizon: ClassVar[int] = 1
    num_envs: Count = 32
    horizon: int = 32
    num_iterations: Count = 4000
    quick_compile: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        if self.horizon != 0 or self.least_horizon > 0:
            COUNT.check("horizon", self.horizon)

    @property
    def samples(self) -> int:
        """Control steps of all environments in one iteration."""
        return self.num_envs * self.horizon

    def steps_in(self, env: Env) -> int:
        """Control steps of one environment in one iteration."""
        return self.horizon or env.episode_length


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyOptions:
    """What every algorithm with a policy network has; the defaults are SAPO's for the deformable tasks.

    Attributes:
      discount: gamma [-].
      actor_learning_rate, final_learning_rate: at the first and from the last iteration on; linear in between.
      optimizer: ``adamw``, or ``adam``: the same without weight decay.
      adam_b1, adam_b2, weight_decay: of all optimizers.
      max_grad_norm: global norm to which each optimizer's gradient is clipped.
      actor_widths, point_widths, point_features, vector_features: network sizes; ``vector_features`` 0: vectors go to
        the policy and the critics as they are.
      activation: ``silu``, ``elu``, ``relu`` or ``tanh``.
      initial_gain: of the orthogonal initialisers of all layers.
      action_gain: of the policy's last layer; None: ``initial_gain``.
      state_dependent_std: the standard deviation is an output of the network; else a parameter of its own.
      log_std_range: clamp of the log standard deviation.
      initial_log_std: the log standard deviation at the start, or, if it depends on the state, added to its bias.
      normalize_observations: running normalisation of vector observations.
      observation_clip: normalised observations stay between minus and plus this, with zero gradient beyond; None: no
        limit. The default is out of reach but for a task's first rollout and for numbers gone astray.
      stagger_episodes: start environments at random points of their time limit, so that they do not reset together.
    """

    discount: Share = 0.99
    actor_learning_rate: Positive = 2e-3
    final_learning_rate: NonNegative = 1e-5
    optimizer: Optimizer = "adamw"
    adam_b1: Decay = 0.7
    adam_b2: Decay = 0.95
    weight_decay: NonNegative = 0.01
    max_grad_norm: Positive = 0.5
    actor_widths: Widths = (512, 256)
    point_widths: Widths = (64, 128, 256)
    point_features: Count = 64
    vector_features: Natural = 128
    activation: Activation = "silu"
    initial_gain: Positive = 1.0
    action_gain: Gain = None
    state_dependent_std: bool = True
    log_std_range: Interval = (-5.0, 2.0)
    initial_log_std: float = 0.0
    normalize_observations: bool = True
    observation_clip: Limit = 100.0
    stagger_episodes: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class CriticOptions:
    """What every algorithm with critics has.

    Attributes:
      critic_learning_rate: at the first iteration.
      num_critics: independent value heads on one encoder.
      critic_widths: sizes of each head.
      value_gain: of the orthogonal initialiser of each head's last layer; None: ``initial_gain``.
    """

    critic_learning_rate: Positive = 5e-4
    num_critics: Count = 2
    critic_widths: Widths = (256, 256)
    value_gain: Gain = None


class GradientFlow(TypedDict):
    """Keyword arguments of ``rewax.agents.rollout.rollout`` that say how it is differentiated."""

    differentiate: Differentiation
    truncate_every: int | None
    state_gradient_decay: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class GradientOptions:
    """How the gradient flows through a rollout.

    Attributes:
      differentiate: what the backward pass stores, see ``rewax.agents.rollout``; ``none``: the actor learns nothing.
      truncate_every: cut the gradient of the environment's state after so many steps; None: never.
      state_gradient_decay: factor on the gradient of the environment's state at every step, 1 for the exact gradient.
      max_env_grad_norm: norm to which the gradient of each environment is clipped before the mean is taken; None: not.
    """

    differentiate: Differentiation = "checkpointed"
    truncate_every: Count | None = None
    state_gradient_decay: Share = 1.0
    max_env_grad_norm: Limit = None

    @property
    def gradient_flow(self) -> GradientFlow:
        """For ``rewax.agents.rollout.rollout``."""
        return {
            "differentiate": self.differentiate,
            "truncate_every": self.truncate_every,
            "state_gradient_decay": self.state_gradient_decay,
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class FittingOptions:
    """How critics are fitted to the values along a differentiated rollout.

    Attributes:
      td_lambda: lambda of the critics' targets, TD(lambda) [-].
      critic_passes, critic_minibatches: how often each iteration's data is used, in how many contiguous parts.
      critic_chunk: samples of a minibatch that are differentiated at a time, their gradients added up; the update is
        the same but for rounding. None: all on an accelerator, as many as fit its cache on a CPU.
      actor_value, target_value: what the actor and the critics' targets see of several critics: ``mean`` or ``min``.
      target_decay: share of the old parameters that the target network keeps each iteration; None: no target network.
    """

    td_lambda: Share = 0.95
    critic_passes: Count = 16
    critic_minibatches: Count = 4
    critic_chunk: int | None = None
    actor_value: Combination = "mean"
    target_value: Combination = "min"
    target_decay: Share | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyConfig(PolicyOptions, RunConfig):
    """Options of an algorithm with a policy network alone."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActorCriticConfig(CriticOptions, PolicyOptions, RunConfig):
    """Options of an algorithm with a policy network and critics."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FirstOrderConfig(FittingOptions, GradientOptions, CriticOptions, PolicyOptions, RunConfig):
    """Options of an actor-critic algorithm that differentiates the simulation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.samples % self.critic_minibatches:
            raise ValueError(
                f"critic_minibatches is {self.critic_minibatches}, which does not divide num_envs * horizon = "
                f"{self.samples}: choose a divisor"
            )
        if self.critic_chunk is not None and (self.critic_chunk < 1 or self.minibatch % self.critic_chunk):
            raise ValueError(
                f"critic_chunk is {self.critic_chunk}, which does not divide a minibatch of {self.minibatch} samples "
                "(num_envs * horizon / critic_minibatches): choose a divisor, or None"
            )

    @property
    def minibatch(self) -> int:
        """Samples in one minibatch of the critics."""
        return self.samples // self.critic_minibatches


AnyPolicyConfig: TypeAlias = PolicyConfig | ActorCriticConfig | FirstOrderConfig
AnyCriticConfig: TypeAlias = ActorCriticConfig | FirstOrderConfig
