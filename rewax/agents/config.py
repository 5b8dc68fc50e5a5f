"""Hyper-parameters that algorithms share.

Options come in five independent groups: ``RunConfig``, ``PolicyOptions``, ``CriticOptions``, ``GradientOptions``,
``FittingOptions``. ``PolicyConfig``, ``ActorCriticConfig`` and ``FirstOrderConfig`` combine them. An algorithm
subclasses one of these and adds options and defaults of its own. The type of an option says which values are legal.
"""

import dataclasses
from typing import Annotated, Any, ClassVar, Literal, Self, TypeAlias, TypedDict

from rewax.agents.legal import (
    COUNT,
    POSITIVE,
    Count,
    Decay,
    EnvLimit,
    Features,
    FeaturesOrNone,
    Interval,
    Legal,
    Natural,
    NonNegative,
    Positive,
    Share,
    Widths,
    check_fields,
    is_whole,
)
from rewax.agents.rollout import Differentiation
from rewax.envs.base import Env

_START_ONLY = frozenset((
    "action_gain", "initial_gain", "initial_horizon", "initial_log_std", "initial_temperature", "stagger_episodes",
    "value_gain",
))  # fmt: skip

Value: TypeAlias = bool | int | float | str | tuple[int | float | str, ...] | None
"""Type of an option's value."""
Optimizer = Literal["adamw", "adam"]
Combination = Literal["mean", "min"]
Activation = Literal["silu", "elu", "relu", "tanh"]


Gain = Annotated[float | None, POSITIVE.or_none("give a positive number, or None for initial_gain")]
Limit = Annotated[float | None, POSITIVE.or_none("give a positive number, or None for no limit")]


def no_memory(why: str) -> Legal:
    """Legal values of ``memory`` of an algorithm that cannot train one; ``why``: what follows a "because"."""
    return Legal(
        f"give 0, because {why}; sapo, shac, apg, ahac, rpo and ppo train a memory", lambda v: is_whole(v) and v == 0
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Options of every algorithm.

    Attributes:
      num_envs: number of environments in a batch.
      horizon: control steps per iteration and environment. 0, if the algorithm allows it: whole episodes, each
        iteration from new initial states.
      num_iterations: number of iterations over which learning rates fall.
      quick_compile: on a CPU, compile with XLA's older code generator and little optimisation, for short runs. On soft
        bodies whose physics runs in C++, a first-order algorithm's train step then compiles in seven to eight tenths of
        the time, and iterations take up to 9 % longer. XLA of jax 0.12 has only one generator, and this option then
        changes nothing.
    """

    least_horizon: ClassVar[int] = 1
    extends: ClassVar[str] = ""
    """Name of the algorithm of a configuration that adds options to those of another algorithm."""
    num_envs: Count = 32
    horizon: int = 32
    num_iterations: Count = 4000
    quick_compile: bool = False

    @property
    def start_only(self) -> frozenset[str]:
        """Options that act at the start of a run alone. A resumed run goes on with what it learnt from its own."""
        return _START_ONLY & {field.name for field in dataclasses.fields(self)}

    def __post_init__(self) -> None:
        check_fields(self)
        if isinstance(self, PolicyOptions):
            self.check_deviation()
        if self.horizon != 0 or self.least_horizon > 0:
            COUNT.check("horizon", self.horizon)

    @classmethod
    def given(cls, config: Self | None) -> Self:
        """The configuration that an algorithm was given, or its defaults for None.

        Raises:
          ValueError: it is that of another algorithm.
        """
        if config is not None and not (isinstance(config, cls) and config.extends == cls.extends):
            raise ValueError(
                f"config is of type {type(config).__name__}: give a {cls.__name__}, or None for its defaults"
            )
        return cls() if config is None else config

    @property
    def samples(self) -> int:
        """Control steps of all environments in one iteration."""
        return self.num_envs * self.horizon

    def steps_in(self, env: Env) -> int:
        """Control steps of one environment in one iteration."""
        return self.horizon or env.episode_length

    def differentiated_steps(self, env: Env) -> int:
        """Control steps of one environment that are differentiated at once, which decides how much memory it takes."""
        return self.steps_in(env)


def steps_in(config: Any, env: Env) -> int:
    """Control steps of one environment per iteration; the horizon for a configuration that is no ``RunConfig``.

    Raises:
      ValueError: the configuration has no horizon.
    """
    if hasattr(config, "steps_in"):
        return config.steps_in(env)
    if not hasattr(config, "horizon"):
        raise ValueError(
            f"{type(config).__name__} has no horizon: derive it from rewax.agents.config.RunConfig, or give it the "
            "fields num_envs, horizon and num_iterations"
        )
    return config.horizon


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyOptions:
    """Options of every algorithm with a policy network. The defaults are SAPO's for the deformable tasks.

    Attributes:
      observe: names of the policy's observations; empty: all.
      discount: gamma [-].
      actor_learning_rate, final_learning_rate: learning rate of the first iteration, and from iteration
        ``num_iterations`` on; linear in between.
      optimizer: ``adamw`` or ``adam``, which has no weight decay.
      adam_b1, adam_b2: decay of the running means of gradients and of their squares, in all optimizers.
      weight_decay: of ``adamw``, in all optimizers.
      max_grad_norm: global norm to which each optimizer's gradient is clipped.
      actor_widths: layer sizes of the policy, behind its encoders.
      point_widths, point_features: layer sizes of the encoder of point clouds, and the number of its outputs.
      vector_features: number of outputs of the encoder of vectors; 0: vectors go to the policy and the critics without
        an encoder.
      picture_widths, picture_features: channels of each layer of the encoder of pictures, and the number of its
        outputs.
      memory: size of the policy's recurrent state, a GRU behind its encoder, see ``rewax.envs.memory``; 0: none.
      activation: ``silu``, ``elu``, ``relu`` or ``tanh``.
      initial_gain: gain of the orthogonal initialisers of all layers.
      action_gain: gain of the policy's last layer; None: ``initial_gain``.
      state_dependent_std: the standard deviation is an output of the network; else it is a parameter.
      log_std_range: clamp of the log standard deviation.
      initial_log_std: initial log standard deviation. If it depends on the state, this is the bias of its output.
      normalize_observations: running normalisation of vector observations and pictures.
      observation_clip: clamp of normalised observations, with zero gradient beyond; None: no limit. The default acts
        only in a task's first rollout and on outliers.
      stagger_episodes: start environments at random times of their episodes, so that they do not reset together. No
        effect where each iteration begins new episodes.
    """

    observe: tuple[str, ...] = ()
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
    point_features: Features = 64
    vector_features: FeaturesOrNone = 128
    picture_widths: Widths = (16, 32, 32)
    picture_features: Features = 64
    memory: Natural = 0
    activation: Activation = "silu"
    initial_gain: Positive = 1.0
    action_gain: Gain = None
    state_dependent_std: bool = True
    log_std_range: Interval = (-5.0, 2.0)
    initial_log_std: float = 0.0
    normalize_observations: bool = True
    observation_clip: Limit = 100.0
    stagger_episodes: bool = False

    def check_deviation(self) -> None:
        """Raises ValueError if the first standard deviation is beyond its clamp, where its gradient is zero.

        A clamp to one number is legal: it fixes the deviation.
        """
        low, high = self.log_std_range
        if low < high and not low <= self.initial_log_std <= high:
            raise ValueError(
                f"initial_log_std is {self.initial_log_std}, but log_std_range is {self.log_std_range}: give a number "
                "between its ends, beyond which the standard deviation learns nothing"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class CriticOptions:
    """Options of every algorithm with critics.

    Attributes:
      critic_observe: names of the critics' observations, which a robot need not have; empty: all.
      critic_learning_rate: learning rate of the first iteration.
      num_critics: number of independent value heads on one encoder.
      critic_widths: layer sizes of each head.
      value_gain: gain of the orthogonal initialiser of each head's last layer; None: ``initial_gain``.
    """

    critic_observe: tuple[str, ...] = ()
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
      differentiate: what the backward pass stores, see ``rewax.agents.rollout``. ``none``: the actor learns nothing.
      truncate_every: cut the gradient of the environment's state every so many steps; None: never.
      state_gradient_decay: factor on the gradient of the environment's state at every step; 1: exact gradient.
      max_env_grad_norm: norm to which each environment's gradient is clipped before the mean; ``median``: the median of
        the environments' norms in this iteration, without zeros; None: no clipping.
    """

    differentiate: Differentiation = "checkpointed"
    truncate_every: Count | None = None
    state_gradient_decay: Share = 1.0
    max_env_grad_norm: EnvLimit = None

    @property
    def gradient_flow(self) -> GradientFlow:
        """Keyword arguments for ``rewax.agents.rollout.rollout``."""
        return {
            "differentiate": self.differentiate,
            "truncate_every": self.truncate_every,
            "state_gradient_decay": self.state_gradient_decay,
        }


Division: TypeAlias = Literal["time", "environments"]
"""What the critics' minibatches divide: the steps in order of time, or the environments, each with all of its steps."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FittingOptions:
    """How critics are fitted to the values along a differentiated rollout.

    Attributes:
      td_lambda: lambda of the critics' targets, TD(lambda) [-].
      critic_passes, critic_minibatches: passes over each iteration's data, and minibatches per pass, divided as
        ``critic_division`` says.
      critic_chunk: number of samples of a minibatch that are differentiated at a time; their gradients are summed. It
        changes the update by rounding only. None: all on an accelerator, as many as fit its cache on a CPU.
      actor_value, target_value: how the actor and the critics' targets combine several critics, ``mean`` or ``min``.
      target_decay: weight of the old parameters in each iteration's update of the target network; None: no target
        network.
    """

    critic_division: ClassVar[Division] = "time"

    td_lambda: Share = 0.95
    critic_passes: Count = 16
    critic_minibatches: Count = 4
    critic_chunk: int | None = None
    actor_value: Combination = "mean"
    target_value: Combination = "min"
    target_decay: Share | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReplayOptions:
    """How an off-policy algorithm stores steps and learns from them.

    A checkpoint holds the replay buffer: with large observations take a smaller one, or checkpoints less often.

    Attributes:
      replay_size: capacity of the replay buffer, in steps of all environments together, rounded down to whole
        iterations. Several devices share the buffer.
      batch_size: samples per update.
      updates: updates per iteration, of the critics where actor and critics have different numbers.
      warmup_steps: control steps per environment with uniformly random actions before the first update. Until then
        ``critic_loss`` is that of the initial critics, and the other metrics of updates are NaN.
      num_steps: n of the n-step returns.
      target_rate: weight of the new parameters in each update of the target network.
      normalize_rewards: divide rewards by the root mean square of the discounted returns in the buffer. Critics then
        learn values of size 1 for any task, and the temperature has the same unit. Without it, critics need many
        updates to reach values of hundreds, and the policy does not learn until then (docs/measured/algorithms.md).
      initial_temperature, temperature_learning_rate, target_entropy_scale: see ``SAPOConfig``.
    """

    replay_size: Count = 1_000_000
    batch_size: Count = 1024
    updates: Count = 8
    warmup_steps: Natural = 32
    num_steps: Count = 3
    target_rate: Share = 0.005
    normalize_rewards: bool = False
    initial_temperature: Positive = 1.0
    temperature_learning_rate: Positive = 5e-3
    target_entropy_scale: Positive = 0.5


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyConfig(PolicyOptions, RunConfig):
    """Options of an algorithm with a policy network and no critics."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActorCriticConfig(CriticOptions, PolicyOptions, RunConfig):
    """Options of an algorithm with a policy network and critics."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReplayConfig(ReplayOptions, CriticOptions, PolicyOptions, RunConfig):
    """Options of an off-policy actor-critic algorithm."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.replay_size < self.samples:
            raise ValueError(
                f"replay_size is {self.replay_size}, less than the {self.samples} steps of one iteration "
                "(num_envs * horizon): make it larger"
            )

    @property
    def capacity(self) -> int:
        """Capacity of the replay buffer, in steps per environment."""
        return self.replay_size // self.samples * self.horizon


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


AnyPolicyConfig: TypeAlias = PolicyConfig | ActorCriticConfig | ReplayConfig | FirstOrderConfig
AnyCriticConfig: TypeAlias = ActorCriticConfig | ReplayConfig | FirstOrderConfig
