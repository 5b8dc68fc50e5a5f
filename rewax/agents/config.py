"""Hyper-parameters that algorithms share, and their checks."""

import dataclasses
import math
from typing import Any, ClassVar, Literal, get_args

from rewax.agents.rollout import Differentiation
from rewax.envs.base import Env

Optimizer = Literal["adamw", "adam"]
Combination = Literal["mean", "min"]
Activation = Literal["silu", "elu", "relu", "tanh"]


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
    num_envs: int = 32
    horizon: int = 32
    num_iterations: int = 4000
    quick_compile: bool = False

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # a list of widths is as good; configurations are hashed
            value = getattr(self, field.name)
            if isinstance(value, list):
                object.__setattr__(self, field.name, tuple(value))
        for name in ("num_envs", "num_iterations"):
            check_count(name, getattr(self, name))
        if self.horizon != 0 or self.least_horizon > 0:
            check_count("horizon", self.horizon)

    @property
    def samples(self) -> int:
        """Control steps of all environments in one iteration."""
        return self.num_envs * self.horizon

    def steps_in(self, env: Env) -> int:
        """Control steps of one environment in one iteration."""
        return self.horizon or env.episode_length


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyConfig(RunConfig):
    """What every algorithm with a policy network has; the defaults are SAPO's for the deformable tasks.

    Attributes:
      discount: gamma [-].
      actor_learning_rate, final_learning_rate: at the first and from the last iteration on; linear in between.
      optimizer: ``adamw``, or ``adam``: the same without weight decay.
      adam_b1, adam_b2, weight_decay: of all optimizers.
      max_grad_norm: global norm to which each optimizer's gradient is clipped.
      actor_widths, point_widths, point_features, vector_features: network sizes.
      activation: ``silu``, ``elu``, ``relu`` or ``tanh``.
      initial_gain: of the orthogonal initialisers of all layers.
      state_dependent_std: the standard deviation is an output of the network; else a parameter of its own.
      log_std_range: clamp of the log standard deviation.
      initial_log_std: the log standard deviation at the start, or, if it depends on the state, added to its bias.
      normalize_observations: running normalisation of vector observations.
      observation_clip: normalised observations stay between minus and plus this, with zero gradient beyond; None: no
        limit. The default is out of reach but for a task's first rollout and for numbers gone astray.
      stagger_episodes: start environments at random points of their time limit, so that they do not reset together.
    """

    discount: float = 0.99
    actor_learning_rate: float = 2e-3
    final_learning_rate: float = 1e-5
    optimizer: Optimizer = "adamw"
    adam_b1: float = 0.7
    adam_b2: float = 0.95
    weight_decay: float = 0.01
    max_grad_norm: float = 0.5
    actor_widths: tuple[int, ...] = (512, 256)
    point_widths: tuple[int, ...] = (64, 128, 256)
    point_features: int = 64
    vector_features: int = 128
    activation: Activation = "silu"
    initial_gain: float = 1.0
    state_dependent_std: bool = True
    log_std_range: tuple[float, float] = (-5.0, 2.0)
    initial_log_std: float = 0.0
    normalize_observations: bool = True
    observation_clip: float | None = 100.0
    stagger_episodes: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_share("discount", self.discount)
        for name in ("actor_learning_rate", "max_grad_norm", "initial_gain"):
            check_positive(name, getattr(self, name))
        if self.observation_clip is not None:
            check_positive("observation_clip", self.observation_clip, "a positive number, or None for no limit")
        check_choice("optimizer", self.optimizer, get_args(Optimizer))
        check_choice("activation", self.activation, get_args(Activation))


@dataclasses.dataclass(frozen=True, kw_only=True)
class SHACPolicyConfig(PolicyConfig):
    """Other defaults: those that SAPO's paper gives the algorithms from before SAPO."""

    optimizer: Optimizer = "adam"
    max_grad_norm: float = 1.0
    activation: Activation = "elu"
    initial_gain: float = 2.0**0.5
    state_dependent_std: bool = False
    initial_log_std: float = -1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActorCriticConfig(PolicyConfig):
    """What every algorithm with critics has.

    Attributes:
      critic_learning_rate: at the first iteration.
      num_critics: independent value heads on one encoder.
      critic_widths: sizes of each head.
    """

    critic_learning_rate: float = 5e-4
    num_critics: int = 2
    critic_widths: tuple[int, ...] = (256, 256)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("num_critics", self.num_critics)
        check_positive("critic_learning_rate", self.critic_learning_rate)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GradientConfig:
    """How the gradient flows through a rollout.

    Attributes:
      differentiate: what the backward pass stores, see ``rewax.agents.rollout``; ``none``: the actor learns nothing.
      truncate_every: cut the gradient of the environment's state after so many steps; None: never.
      state_gradient_decay: factor on the gradient of the environment's state at every step, 1 for the exact gradient.
      max_env_grad_norm: norm to which the gradient of each environment is clipped before the mean is taken; None: not.
    """

    differentiate: Differentiation = "checkpointed"
    truncate_every: int | None = None
    state_gradient_decay: float = 1.0
    max_env_grad_norm: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()  # type: ignore[misc]  # of the configuration that it is mixed into
        check_choice("differentiate", self.differentiate, get_args(Differentiation))
        if self.truncate_every is not None:
            check_count("truncate_every", self.truncate_every)
        check_share("state_gradient_decay", self.state_gradient_decay)
        if self.max_env_grad_norm is not None:
            check_positive("max_env_grad_norm", self.max_env_grad_norm, "a positive number, or None for no limit")

    @property
    def rollout_options(self) -> dict[str, Any]:
        """Keyword arguments of ``rewax.agents.rollout.rollout``."""
        names = ("horizon", "differentiate", "truncate_every", "state_gradient_decay")
        return {name: getattr(self, name) for name in names}


@dataclasses.dataclass(frozen=True, kw_only=True)
class FirstOrderConfig(GradientConfig, ActorCriticConfig):
    """What every first-order actor-critic algorithm has.

    Attributes:
      td_lambda: lambda of the critics' targets [-].
      critic_passes, critic_minibatches: how often each iteration's data is used, in how many contiguous parts.
      critic_chunk: samples of a minibatch that are differentiated at a time, their gradients added up; the update is
        the same but for rounding. None: all on an accelerator, as many as fit its cache on a CPU.
      actor_value, target_value: what the actor and the critics' targets see of several critics: ``mean`` or ``min``.
      target_decay: share of the old parameters that the target network keeps each iteration; None: no target network.
    """

    td_lambda: float = 0.95
    critic_passes: int = 16
    critic_minibatches: int = 4
    critic_chunk: int | None = None
    actor_value: Combination = "mean"
    target_value: Combination = "min"
    target_decay: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("critic_passes", "critic_minibatches"):
            check_count(name, getattr(self, name))
        check_share("td_lambda", self.td_lambda)
        for name in ("actor_value", "target_value"):
            check_choice(name, getattr(self, name), ("mean", "min"))
        if self.target_decay is not None:
            check_share("target_decay", self.target_decay)
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


def check_count(name: str, value: Any) -> None:
    """Raises ValueError unless ``value`` is a whole number of at least 1."""
    if not isinstance(value, int) or value < 1:
        raise ValueError(f"{name} is {value}: give a whole number of at least 1")


def check_share(name: str, value: float) -> None:
    """Raises ValueError unless ``value`` lies between 0 and 1."""
    if not (isinstance(value, (int, float)) and 0.0 <= value <= 1.0):
        raise ValueError(f"{name} is {value}: give a number between 0 and 1")


def check_positive(name: str, value: float, wanted: str = "a positive number") -> None:
    """Raises ValueError unless ``value`` is finite and above 0."""
    if not (isinstance(value, (int, float)) and value > 0.0 and math.isfinite(value)):
        raise ValueError(f"{name} is {value}: give {wanted}")


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raises ValueError unless ``value`` is one of ``choices``."""
    if value not in choices:
        listed = f"{', '.join(choices[:-1])} or {choices[-1]}"
        raise ValueError(f"{name} is {value!r}: use {listed}")
