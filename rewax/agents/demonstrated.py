"""SAPO from demonstrations: a policy that first imitates an optimised open-loop sequence of actions.

A run has two phases; the number of the iteration decides. In the first phase an iteration is one of
``rewax.agents.trajopt``: every environment plays the sequence from a new initial state to its end, and Adam updates the
sequence. Then the actor is regressed onto the played actions, and the critics onto the returns. In the second phase an
iteration is one of ``rewax.agents.sapo``.

Source: imitation of optimised trajectories before reinforcement learning, after Levine and Koltun 2013, "Guided Policy
Search"; SAPO: Xing, Luk and Oh 2025. Differences:

- Adam optimises one sequence for all initial states. Theirs are one trajectory each, by dynamic programming.
- The policy is regressed with squared errors of its mode and of its log standard deviation, which keeps its initial
  value.
- The sequence is not regularised towards the policy.

Whole episodes of the first phase are differentiated with ``checkpointed``, whatever ``differentiate`` says.
"""

import dataclasses
import functools
import warnings
from collections.abc import Callable
from typing import ClassVar, TypeAlias

import jax
import jax.numpy as jnp
import optax

from rewax import struct
from rewax.agents import sapo, trajopt
from rewax.agents.actor_critic import actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import no_memory
from rewax.agents.first_order import Rollout, at_iteration, critic_optimizer, critic_update, start_actor_critic
from rewax.agents.gradients import mean_gradient, per_env_gradients
from rewax.agents.legal import Count, Positive, Share
from rewax.agents.optimizers import apply, finite_or_zero
from rewax.agents.rollout import Transition, first_episode, masked
from rewax.agents.run_state import staggered
from rewax.agents.sapo import Networks, SAPOConfig
from rewax.agents.temperature import SoftState, start_temperature
from rewax.agents.trajopt import TrajOptConfig
from rewax.envs.base import Env
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.types import Array, Key, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class DemonstratedConfig(SAPOConfig):
    """Hyper-parameters beyond SAPO's.

    Attributes:
      num_iterations: control steps of both phases, divided by ``horizon``. The first phase has longer iterations. A run
        that is resumed in its second phase with a larger number stays in it.
      max_env_grad_norm: limit in the second phase. The sequence's gradient has none, as in ``trajopt``'s presets: it is
        that of a whole episode's return by actions.
      demonstration_share: share of the control steps that the first phase gets.
      sequence_learning_rate: learning rate of Adam for the sequence.
      cloning_learning_rate, cloning_passes: learning rate of the actor's regression, and its passes over the data of
        each iteration.
    """

    extends: ClassVar[str] = "sapo_from_demonstrations"
    demonstration_share: Share = 0.5
    sequence_learning_rate: Positive = 1e-2
    cloning_learning_rate: Positive = 2e-3
    cloning_passes: Count = 16

    def __post_init__(self) -> None:
        super().__post_init__()
        no_memory("the actor imitates single steps of the sequence").check("memory", self.memory)

    def demonstrations(self, env: Env) -> int:
        """Number of iterations of the first phase."""
        return int(self.demonstration_share * self.num_iterations * self.horizon) // env.episode_length

    def differentiated_steps(self, env: Env) -> int:
        """Control steps of one environment that are differentiated at once: an episode, if there is a first phase."""
        return env.episode_length if self.demonstrations(env) else super().differentiated_steps(env)

    def second_phase(self, env: Env) -> SAPOConfig:
        """Options of SAPO in the second phase, with its iterations after a first phase of ``demonstrations``.

        Learning rates fall over these iterations; ``on_schedule`` stretches them where the first phase had another
        length. The critics' rate falls in the first phase, too, as fast, and begins anew in the second.
        """
        left = self.num_iterations - self.demonstrations(env) * env.episode_length // self.horizon
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(SAPOConfig)}
        return SAPOConfig(**{**fields, "num_iterations": max(1, left)})

    @property
    def sequence(self) -> TrajOptConfig:
        """Options of TrajOpt in the first phase."""
        return TrajOptConfig(
            num_envs=self.num_envs,
            learning_rate=self.sequence_learning_rate,
            state_gradient_decay=self.state_gradient_decay,
            truncate_every=self.truncate_every,
        )


@struct.dataclass
class DemonstratedState(SoftState):
    """The complete state of a run; this is what a checkpoint stores.

    Attributes:
      actions, actions_opt: the sequence, shape (episode_length, action_size), and the state of its optimizer.
      cloning_opt: state of the optimizer of the actor's regression.
    """

    actions: Array
    actions_opt: PyTree
    cloning_opt: PyTree


Phase: TypeAlias = Callable[[DemonstratedState], tuple[DemonstratedState, Metrics]]


def make_demonstrated(
    env: Env, config: DemonstratedConfig | None = None, *, randomize: Randomize | None = None
) -> Agent:
    """SAPO from demonstrations; arguments as for ``rewax.agents.actor_critic.actor_agent``."""
    config = DemonstratedConfig.given(config)
    length = EnvLeaves.of(env).first().episode_length
    if config.num_envs * length % config.critic_minibatches:
        raise ValueError(
            f"critic_minibatches is {config.critic_minibatches}, which does not divide num_envs * episode length = "
            f"{config.num_envs * length}: choose a divisor"
        )
    if config.demonstration_share > 0 and not config.demonstrations(EnvLeaves.of(env).first()):
        share = config.demonstration_share
        warnings.warn(
            f"the run is too short for a demonstration: {share:g} of {config.num_iterations} iterations of "
            f"{config.horizon} steps is less than an episode of {length}, so this is SAPO without demonstrations",
            stacklevel=2,
        )
    return actor_agent("sapo_from_demonstrations", env, config, init=init, train_step=train_step, randomize=randomize)


def init(config: DemonstratedConfig, leaves: EnvLeaves, key: Key) -> DemonstratedState:
    """The first state of a run. All actions of the sequence are zero."""
    env = leaves.first()
    networks = make_actor_critic(env, config.second_phase(env))
    log_alpha, opt = start_temperature(networks, config.initial_temperature, config.temperature_learning_rate)
    actions = jnp.zeros((env.episode_length, *env.action_spec.shape))
    state = start_actor_critic(
        DemonstratedState, networks, leaves, key, log_temperature=log_alpha, temperature_opt=opt, actions=actions,
        actions_opt=config.sequence.optimizer.init(actions), cloning_opt=(),
    )  # fmt: skip
    return state.replace(cloning_opt=networks.optimizer(config.cloning_learning_rate).init(state.actor_params))


def train_step(config: DemonstratedConfig, state: DemonstratedState) -> tuple[DemonstratedState, Metrics]:
    """One iteration of the current phase. Metrics of the other phase are NaN, counters 0.

    Under ``vmap``, as with ``--num-seeds``, every iteration computes both phases.
    """
    env = state.environments.env.first()
    phases: tuple[Phase, Phase] = (
        functools.partial(demonstration_step, config),
        functools.partial(reinforcement_step, config),
    )
    first, second = (jax.eval_shape(phase, state)[1] for phase in phases)
    everything = {**first, **second}

    def completed(phase: Phase, state: DemonstratedState) -> tuple[DemonstratedState, Metrics]:
        new, metrics = phase(state)
        return new, {name: metrics.get(name, _absent(s)).astype(s.dtype) for name, s in everything.items()}

    branches = (functools.partial(completed, phase) for phase in phases)
    still = (state.iteration < config.demonstrations(env)) & (shown_so_far(state) == state.iteration)
    return jax.lax.cond(still, *branches, state)


def shown_so_far(state: DemonstratedState) -> Array:
    """Number of iterations of the first phase so far, shape (): Adam's count of updates of the sequence."""
    return optax.tree.get(state.actions_opt, "count")


def demonstration_step(config: DemonstratedConfig, state: DemonstratedState) -> tuple[DemonstratedState, Metrics]:
    """One iteration of the first phase: sequence, actor, critics."""
    env = state.environments.env.first()
    networks = make_actor_critic(env, config.second_phase(env))
    key, loss_key, reset_key, stagger_key = jax.random.split(state.key, 4)
    state = state.replace(environments=state.environments.restarted(reset_key))

    loss = functools.partial(trajopt.sequence_loss, config=config.sequence)
    losses, (end, t), grads = per_env_gradients(loss, state.actions, state.common(), state.environments, loss_key)
    grad, metrics = mean_gradient(losses, grads)
    actions, opt = apply(config.sequence.optimizer, grad, state.actions_opt, state.actions)
    actions = jnp.clip(actions, env.action_spec.low, env.action_spec.high)

    shown = first_episode(t)
    state, cloning_metrics = clone(config, networks, state.replace(actions=actions, actions_opt=opt), shown)
    next_obs = networks.normalize(state.environments.statistics, t.next_obs)
    next_values = jax.vmap(functools.partial(networks.values, state.critic_params))(next_obs)
    state, critic_metrics = critic_update(networks, state, Rollout(end, shown, next_values), shown.reward)
    state, episode_metrics = trajopt.after_sequence(config, state, end, t, key)
    if config.stagger_episodes:  # for the second phase; the first one restarts all environments
        state = state.replace(environments=staggered(state.environments, stagger_key))
    return state, {**episode_metrics, **metrics, **cloning_metrics, **critic_metrics}


def reinforcement_step(config: DemonstratedConfig, state: DemonstratedState) -> tuple[DemonstratedState, Metrics]:
    """One iteration of the second phase. The critics' optimizer begins anew in the first one."""
    env = state.environments.env.first()
    options = config.second_phase(env)
    fresh = critic_optimizer(make_actor_critic(env, options)).init(state.critic_params)
    begins = state.iteration == shown_so_far(state)
    opt = jax.tree.map(lambda new, old: jnp.where(begins, new, old), fresh, state.critic_opt)
    return sapo.train_step(options, on_schedule(config, state.replace(critic_opt=opt)))


def on_schedule(config: DemonstratedConfig, state: DemonstratedState) -> DemonstratedState:
    """The state with learning rates that fall until the run's last iteration, also if the first phase was that of a
    run with another number of iterations."""
    env, shown = state.environments.env.first(), shown_so_far(state)
    planned = config.second_phase(env).num_iterations
    left = jnp.maximum(config.num_iterations - shown * env.episode_length // config.horizon, 1)
    return at_iteration(config, state, (state.iteration - shown) * planned // left)


def clone(
    config: DemonstratedConfig, networks: Networks, state: DemonstratedState, transitions: Transition
) -> tuple[DemonstratedState, Metrics]:
    """Regress the actor onto the actions of a rollout.

    Args:
      config, networks, state: the policy network with its optimizer, and the run.
      transitions: from ``first_episode``, leading axes (num_envs, T).

    Returns:
      The new state, and the metric ``cloning_loss``.
    """
    counts = transitions.valid
    obs = networks.normalize(state.environments.statistics, transitions.obs)
    obs, actions = masked((dict(obs), transitions.action), counts)
    flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), (obs, actions, counts))
    optimizer = networks.optimizer(config.cloning_learning_rate)

    def update(carry: tuple[PyTree, PyTree], _: None) -> tuple[tuple[PyTree, PyTree], Array]:
        params, opt = carry
        loss, grad = jax.value_and_grad(cloning_loss)(params, *flat, networks=networks)
        return apply(optimizer, finite_or_zero(grad), opt, params), loss

    start = (state.actor_params, state.cloning_opt)
    (params, opt), losses = jax.lax.scan(update, start, None, length=config.cloning_passes)
    return state.replace(actor_params=params, cloning_opt=opt), {"cloning_loss": losses[-1]}


def cloning_loss(params: PyTree, obs: PyTree, actions: Array, counts: Array, *, networks: Networks) -> Array:
    """Mean squared error of the actor's mode plus that of its log standard deviation. Gradient: exact.

    Args:
      params: parameters of the actor.
      obs: observations from ``Actor.normalize``, leading axis (n,).
      actions: the played actions, shape (n, action_size).
      counts: mask of the samples to use, shape (n,), bool.
      networks: the policy network.
    """
    policy = jax.vmap(functools.partial(networks.distribution, params))(obs)
    errors = (policy.mode() - actions) ** 2 + (policy.log_std - networks.config.initial_log_std) ** 2
    return jnp.sum(jnp.where(counts[:, None], errors, 0.0)) / (jnp.maximum(counts.sum(), 1) * actions.shape[1])


def _absent(shape: jax.ShapeDtypeStruct) -> Array:
    return jnp.full(shape.shape, jnp.nan if jnp.issubdtype(shape.dtype, jnp.floating) else 0, shape.dtype)
