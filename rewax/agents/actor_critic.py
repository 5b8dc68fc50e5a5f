"""Actor and critics bound to a configuration: functions of parameters, observation statistics and observations."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Generic, TypeVar, cast

import jax
import jax.numpy as jnp
import optax

from rewax.agents.base import Agent, Metrics, bind
from rewax.agents.config import AnyCriticConfig, AnyPolicyConfig
from rewax.agents.distributions import TanhNormal
from rewax.agents.networks import ACTIVATIONS, Critics, Encoder, GaussianActor
from rewax.agents.normalization import RunningStatistics, normalize
from rewax.agents.optimizers import apply, clipped_adamw, finite_or_zero, linear_fall
from rewax.agents.rollout import Policy
from rewax.agents.run_state import PolicyState, partition
from rewax.envs.base import ArraySpec, Env
from rewax.envs.leaves import EnvLeaves
from rewax.envs.memory import MEMORY, Remembered, remembered
from rewax.envs.randomized import Randomize
from rewax.envs.registry import did_you_mean
from rewax.types import Array, Key, Observation, PyTree

P = TypeVar("P", bound=AnyPolicyConfig, covariant=True)
C = TypeVar("C", bound=AnyCriticConfig, covariant=True)
S = TypeVar("S", bound=PolicyState)


@dataclasses.dataclass(frozen=True)
class Actor(Generic[P]):
    """The policy network and its optimizer, built from a configuration and the specs of an environment.

    Attributes:
      config: network sizes and learning rates.
      network: the flax module of the policy.
      action_size: number of action components.
      observation_spec: the environment's ``observation_spec``.
    """

    config: P
    network: GaussianActor
    action_size: int
    observation_spec: dict[str, ArraySpec]

    @property
    def shapes_read(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the observations that the policy reads, by name, without its memory."""
        shapes = {name: tuple(spec.shape) for name, spec in self.observation_spec.items() if name != MEMORY}
        return {name: shapes[name] for name in shapes if name in (self.config.observe or shapes)}

    def normalize(self, statistics: RunningStatistics, obs: Observation) -> Observation:
        """The observations that the networks take as input. Gradient: exact with respect to obs."""
        if not self.config.normalize_observations:
            return obs
        return normalize(statistics, obs, clip=self.config.observation_clip)

    def action_distribution(self, params: PyTree, statistics: RunningStatistics, obs: Observation) -> TanhNormal:
        """The distribution of one environment's action. Gradient: exact with respect to params and obs."""
        return self.distribution(params, self.normalize(statistics, obs))

    def distribution(self, params: PyTree, normalized: Observation) -> TanhNormal:
        """The action distribution for an observation that ``normalize`` returned."""
        return self.decide(params, normalized)[0]

    def decide(self, params: PyTree, normalized: Observation) -> tuple[TanhNormal, Array | None]:
        """The action distribution, and the memory after an observation that ``normalize`` returned; None without."""
        mean, log_std, *memory = cast(tuple[Array, ...], self.network.apply(params, normalized))
        return TanhNormal(mean=mean, log_std=log_std), memory[0] if memory else None

    def distributions(self, params: PyTree, normalized: Observation, begins: Array) -> TanhNormal:
        """The action distributions of a sequence; the memory goes from each step to the next.

        Args:
          params: parameters of the policy.
          normalized: observations that ``normalize`` returned, leading axis of time.
          begins: where the memory of the observation counts: the first step, and the first of each episode, shape
            (T,), bool. Elsewhere it is that of the step before.

        Gradient: exact, through time.
        """

        def step(memory: Array, given: tuple[Observation, Array]) -> tuple[Array, TanhNormal]:
            obs, begins = given
            distribution, new = self.decide(params, {**obs, MEMORY: jnp.where(begins, obs[MEMORY], memory)})
            assert new is not None, "distributions needs a policy with memory"
            return new, distribution

        return jax.lax.scan(step, jnp.zeros_like(normalized[MEMORY][0]), (normalized, begins))[1]

    def sampling(self, params: PyTree, statistics: RunningStatistics) -> Policy:
        """A policy for ``rollout`` that samples its actions. Gradient: with respect to params and obs."""

        def policy(obs: Observation, key: Key) -> tuple[Array, dict[str, Array]]:
            distribution, memory = self.decide(params, self.normalize(statistics, obs))
            return remembered(distribution.sample(key), memory), {}

        return policy

    def policy(self, state: PolicyState, obs: Observation, key: Key, deterministic: bool = False) -> Any:
        """``Agent.policy`` of every algorithm with a policy network; ``PolicyWithMemory`` where it has a memory."""
        normalized = self.normalize(state.environments.statistics, obs)
        distribution, memory = self.decide(state.actor_params, normalized)
        return remembered(distribution.mode() if deterministic else distribution.sample(key), memory)

    @property
    def actor_optimizer(self) -> optax.GradientTransformation:
        """The actor's optimizer: one update per iteration, with a learning rate that falls linearly."""
        return self.falling_optimizer(self.config.actor_learning_rate, 1)

    def optimizer(self, learning_rate: optax.ScalarOrSchedule) -> optax.GradientTransformation:
        """The configuration's Adam with a given learning rate."""
        config = self.config
        return clipped_adamw(
            learning_rate,
            max_grad_norm=config.max_grad_norm,
            b1=config.adam_b1,
            b2=config.adam_b2,
            weight_decay=config.weight_decay if config.optimizer == "adamw" else 0.0,
        )

    def falling_optimizer(self, learning_rate: float, updates_per_iteration: int) -> optax.GradientTransformation:
        """The configuration's Adam. Its learning rate falls linearly from the given one to ``final_learning_rate``."""
        return self.optimizer(
            linear_fall(
                learning_rate,
                self.config.final_learning_rate,
                self.config.num_iterations,
                updates_per_iteration=updates_per_iteration,
            )
        )

    def update(
        self, learning_rate: float, grad: PyTree, opt_state: PyTree, params: PyTree, *, scale: Array | float = 1.0
    ) -> tuple[PyTree, PyTree]:
        """One step of the configuration's Adam; returns parameters and optimizer state.

        The step is multiplied by ``scale``. Non-finite components of the gradient are replaced by zero.
        """
        return apply(self.optimizer(learning_rate), finite_or_zero(grad), opt_state, params, scale=scale)


@dataclasses.dataclass(frozen=True, eq=False)
class PolicyWithMemory:
    """``Agent.policy`` of an algorithm whose policy has a memory.

    The observation has the memory under the name ``memory``; the result is ``Remembered(action, memory)``.
    """

    actor: Actor[AnyPolicyConfig]

    def __call__(self, state: PolicyState, obs: Observation, key: Key, deterministic: bool = False) -> Remembered:
        """One environment's action, and the memory of its next step."""
        if MEMORY not in obs:
            raise ValueError(
                f"the observation has no {MEMORY!r}, but the policy has one: add policy.initial_memory() at the first "
                "step of an episode, and what the policy returned at later ones"
            )
        return self.actor.policy(state, obs, key, deterministic)

    def initial_memory(self) -> Array:
        """The memory at the beginning of an episode, shape (size,)."""
        return jnp.zeros(self.actor.config.memory)


def actor_of(policy: Callable[..., Any]) -> Actor[Any] | None:
    """The actor of an ``Agent.policy`` that ``actor_agent`` made; None for another policy."""
    actor = policy.actor if isinstance(policy, PolicyWithMemory) else getattr(policy, "__self__", None)
    return actor if isinstance(actor, Actor) else None


@dataclasses.dataclass(frozen=True)
class ActorCritic(Actor[C]):
    """The policy network, the critics and their optimizers.

    Attributes:
      critics: the flax module of the critics.
    """

    critics: Critics

    def values(self, params: PyTree, normalized: Observation) -> Array:
        """State values from all critics, shape (n, num_critics), for n observations that ``normalize`` returned."""
        return cast(Array, jax.vmap(lambda obs: self.critics.apply(params, obs))(normalized))

    def action_values(self, params: PyTree, normalized: Observation, action: Array) -> Array:
        """Action values from all critics, shape (n, num_critics), for n normalised observations and actions."""
        return cast(Array, jax.vmap(lambda *one: self.critics.apply(params, *one))(normalized, action))


def make_actor(env: Env, config: P) -> Actor[P]:
    """Policy network and optimizer for an environment. Only the environment's specs are used.

    Raises:
      ValueError: actions are no vectors bounded by -1 and 1, or ``observe`` names what the environment does not
        observe.
    """
    return Actor(config, _network(env, config), env.action_spec.shape[0], env.observation_spec)


def make_actor_critic(env: Env, config: C, *, num_outputs: int = 1) -> ActorCritic[C]:
    """Networks and optimizers for an environment; errors as for ``make_actor``. ``num_outputs``: of each critic."""
    _check_names("critic_observe", config.critic_observe, env)
    sizes = (config.critic_widths, config.num_critics)
    activation = ACTIVATIONS[config.activation]
    critics = Critics(
        _encoder(config, config.critic_observe),
        *sizes,
        activation,
        config.initial_gain,
        config.value_gain,
        num_outputs,
    )
    return ActorCritic(config, _network(env, config), env.action_spec.shape[0], env.observation_spec, critics)


def actor_agent(
    name: str,
    env: Env,
    config: P,
    *,
    init: Callable[[P, EnvLeaves, Key], S],
    train_step: Callable[[P, S], tuple[S, Metrics]],
    randomize: Randomize | None = None,
    donate: bool = False,
) -> Agent[S]:
    """Builds the agent of an algorithm that has a policy network.

    Args:
      name: the algorithm's name.
      env: one environment without auto-reset, or a batch of ``num_envs`` environments (``rewax.envs.stack``).
      config: hyper-parameters.
      init, train_step, donate: see ``bind``.
      randomize: ``(key, env) -> env``, called at each reset to draw new parameters of the environment.

    Returns:
      The agent. It begins new episodes by itself.

    Raises:
      ValueError: the environment resets by itself, is a batch of another size than ``num_envs``, has actions that are
        no vectors in [-1, 1], or lacks an observation that the configuration names; or ``randomize`` or ``memory`` does
        not fit the environment.
    """
    leaves = partition(env, config.num_envs, randomize, memory=config.memory)
    actor = make_actor(leaves.first(), config)
    policy = PolicyWithMemory(actor) if config.memory else actor.policy
    return bind(name, config, leaves, init=init, train_step=train_step, policy=policy, donate=donate)


def _encoder(config: AnyPolicyConfig, observe: tuple[str, ...]) -> Encoder:
    return Encoder(
        point_widths=config.point_widths,
        point_features=config.point_features,
        vector_features=config.vector_features,
        activation=ACTIVATIONS[config.activation],
        gain=config.initial_gain,
        picture_widths=config.picture_widths,
        picture_features=config.picture_features,
        observe=observe,
    )


def _check_names(option: str, names: tuple[str, ...], env: Env) -> None:
    """Raises ValueError for a name that no observation has."""
    known = env.observation_spec
    for name in names:
        if name not in known:
            raise ValueError(
                f"{option} has {name!r}, which the environment does not observe: {did_you_mean(name, known)}use "
                f"{', '.join(known)}, or nothing for all"
            )


def _check_actions(env: Env) -> None:
    """Raises ValueError unless actions are vectors in [-1, 1], as the tanh of a policy is."""
    low, high, shape = env.action_spec.low, env.action_spec.high, env.action_spec.shape
    if len(shape) != 1 or not shape[0]:
        raise ValueError(
            f"action_spec has the shape {shape}, but policies return vectors: give it the shape "
            f"({max(math.prod(shape), 1)},), and reshape the action in step"
        )
    if (low, high) != (-1.0, 1.0):
        raise ValueError(
            f"action_spec has the bounds {low} and {high}, but policies act in [-1, 1]: give it the bounds -1 and 1, "
            "and scale the action in step"
        )


def _network(env: Env, config: AnyPolicyConfig) -> GaussianActor:
    _check_actions(env)
    if config.memory and MEMORY in config.observe:
        raise ValueError(f"observe has {MEMORY!r}, the policy's own memory, which it always sees: leave it out")
    _check_names("observe", config.observe, env)
    return GaussianActor(
        _encoder(config, config.observe),
        config.actor_widths,
        env.action_spec.shape[0],
        ACTIVATIONS[config.activation],
        config.initial_gain,
        config.log_std_range,
        config.initial_log_std,
        config.state_dependent_std,
        config.action_gain,
        config.memory,
    )
