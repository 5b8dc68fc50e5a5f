"""AHAC, adaptive-horizon actor-critic: SHAC whose horizon shrinks where the gradient grows too fast.

Source: Georgiev et al. 2024, "Adaptive Horizon Actor-Critic for Policy Learning in Contact-Rich Differentiable
Simulation" (ICML 2024). Differences:

- They bound the stiffness of the dynamics, measured by contact forces and accelerations. Here the backward pass of any
  environment gives it: the logarithm of the factor by which the gradient of the state grows over a step.
- All environments share one horizon. It moves by the mean excess of that growth, an earlier rule of the authors. Theirs
  has a multiplier for each step. The growth of a sum of equal rewards, whose gradient adds up, is no excess.
- Rollouts have room for ``horizon`` steps. Beyond the adaptive horizon the environments stand still. These steps cost
  nothing, but under ``vmap`` over seeds (``--num-seeds``) they are computed and left out.
- A run has a given number of control steps, theirs of iterations. So the learning rates fall with the steps.
- Critics are fitted with a fixed number of passes, theirs until the loss stays about the same, with 64 passes at most.
- A minibatch of the critics has all steps of some environments, theirs some steps of all environments. Here the
  minibatches beyond the horizon would be empty.
"""

import dataclasses
import functools
from typing import Annotated, ClassVar, TypeAlias

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import Activation, Combination, Division, FirstOrderConfig, Optimizer
from rewax.agents.first_order import Rollout, actor_step, at_iteration, critic_update, rollout_loss, start_actor_critic
from rewax.agents.gradients import per_env_gradients
from rewax.agents.legal import AT_LEAST_2, Positive
from rewax.agents.rollout import Transition, rollout
from rewax.agents.run_state import ActorCriticState
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class AHACConfig(FirstOrderConfig):
    """Hyper-parameters beyond those of ``FirstOrderConfig``.

    Attributes:
      horizon: the longest horizon.
      min_horizon, initial_horizon: the shortest horizon, and the horizon of the first iteration; at least 2, because
        the growth of the gradient compares two states.
      max_growth: growth of the norm of the state's gradient per control step above which the horizon H shrinks [-]. For
        short horizons the limit is H^(1 / (H - 1)), the mean growth for H equal rewards, if that is larger.
      horizon_rate: control steps by which the horizon moves per iteration and unit of excess.
      critic_minibatches: a divisor of num_envs.
    """

    critic_division: ClassVar[Division] = "environments"

    optimizer: Optimizer = "adam"
    max_grad_norm: float = 1.0
    activation: Activation = "elu"
    initial_gain: float = 2.0**0.5
    state_dependent_std: bool = False
    initial_log_std: float = -1.0
    actor_value: Combination = "min"
    horizon: int = 64
    min_horizon: Annotated[int, AT_LEAST_2] = 8
    initial_horizon: Annotated[int, AT_LEAST_2] = 32
    max_growth: Positive = 1.1
    horizon_rate: Positive = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_envs % self.critic_minibatches:
            raise ValueError(
                f"critic_minibatches is {self.critic_minibatches}, which does not divide num_envs = {self.num_envs}: "
                "choose a divisor, because a minibatch of AHAC has all steps of some environments"
            )
        if not self.min_horizon <= self.initial_horizon <= self.horizon:
            raise ValueError(
                f"min_horizon is {self.min_horizon}, initial_horizon {self.initial_horizon}, horizon {self.horizon}: "
                "give them in this order, the smallest first"
            )

    def steps_in(self, env: Env) -> int:
        """Control steps of one environment in the first iteration. Later iterations follow ``AHACState.horizon``."""
        del env
        return self.initial_horizon

    def differentiated_steps(self, env: Env) -> int:
        """Control steps of one environment that a rollout has room for."""
        del env
        return self.horizon


Networks: TypeAlias = ActorCritic[AHACConfig]


@struct.dataclass
class AHACState(ActorCriticState):
    """The complete state of a run; this is what a checkpoint stores.

    Attributes:
      horizon: horizon of the next iteration, rounded to whole steps when it is used, shape ().
    """

    horizon: Array


def make_ahac(env: Env, config: AHACConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """AHAC on an environment; arguments as for ``rewax.agents.actor_critic.actor_agent``."""
    config = AHACConfig.given(config)
    return actor_agent("ahac", env, config, init=init, train_step=train_step, randomize=randomize)


def init(config: AHACConfig, leaves: EnvLeaves, key: Key) -> AHACState:
    """The first state of a run."""
    networks = make_actor_critic(leaves.first(), config)
    return start_actor_critic(AHACState, networks, leaves, key, horizon=jnp.full((), float(config.initial_horizon)))


def train_step(config: AHACConfig, state: AHACState) -> tuple[AHACState, Metrics]:
    """One iteration: actor, critics, horizon."""
    networks = make_actor_critic(state.environments.env.first(), config)
    key, rollout_key = jax.random.split(state.key)
    loss = functools.partial(actor_loss, networks=networks)
    state = on_schedule(config, state)

    params = (state.actor_params, jnp.zeros(config.horizon))
    losses, rollouts, (grads, norms) = per_env_gradients(loss, params, state.common(), state.environments, rollout_key)
    state, actor_metrics = actor_step(networks, state, losses, grads, max_norm=config.max_env_grad_norm)
    state, critic_metrics = critic_update(networks, state, rollouts, rollouts.transitions.reward)
    state, horizon_metrics = horizon_update(config, state, gradient_growth(norms, rollouts.transitions))

    state, episode_metrics = state.after(config, rollouts.end, rollouts.transitions, key)
    return state, {**episode_metrics, **horizon_metrics, **actor_metrics, **critic_metrics}


def on_schedule(config: AHACConfig, state: AHACState) -> AHACState:
    """The state with learning rates that belong to its control steps, whatever the number of its iterations."""
    return at_iteration(config, state, state.env_steps // (config.num_envs * config.initial_horizon))


def actor_loss(
    params: tuple[PyTree, Array], common: AHACState, env: AutoReset, env_state: State, key: Key, *, networks: Networks
) -> tuple[Array, Rollout]:
    """Minus the return per step of one environment's rollout over the adaptive horizon.

    Args:
      params: the actor's parameters, and the probes of ``rollout``.

    Gradient: through the simulation. With respect to the probes: norms of the cotangents of the states.
    """
    (actor_params, probes), config = params, networks.config
    policy = networks.sampling(actor_params, common.environments.statistics)
    end, t = rollout(
        env,
        env_state,
        policy,
        key,
        horizon=config.horizon,
        num_active=jnp.round(common.horizon).astype(jnp.int32),
        probes=probes,
        **config.gradient_flow,
    )
    return rollout_loss(networks, common, end, t, t.reward)


def horizon_update(config: AHACConfig, state: AHACState, growth: Array) -> tuple[AHACState, Metrics]:
    """Move the horizon against the excess of the gradient's growth.

    Args:
      config, state: the run.
      growth: mean log growth from ``gradient_growth``. Where it is not known (NaN), the horizon stays.

    Returns:
      The new state, and the metrics ``horizon`` (of the last rollout) and ``growth``.
    """
    steps = jnp.round(state.horizon)
    of_a_sum = jnp.log(steps) / (steps - 1.0)  # the gradient of n equal rewards is n times that of the last one
    allowed = jnp.maximum(jnp.log(config.max_growth), of_a_sum)
    excess = jnp.where(jnp.isnan(growth), 0.0, growth - allowed)
    horizon = state.horizon - config.horizon_rate * excess
    new = state.replace(horizon=jnp.clip(horizon, config.min_horizon, config.horizon))
    return new, {"horizon": jnp.round(state.horizon), "growth": jnp.exp(growth)}


def gradient_growth(norms: Array, transitions: Transition) -> Array:
    """Mean logarithm of the factor by which the state's gradient grows backwards over a control step, shape ().

    A norm that overflows counts as the largest float, and one that is NaN does not count. NaN if no step counts.

    Args:
      norms: norms of the gradient with respect to the state before each step, shape (num_envs, T).
      transitions: leading axes (num_envs, T). Steps that end an episode cut the gradient and are left out.
    """
    before, after = norms[:, :-1], norms[:, 1:]
    counts = transitions.active[:, 1:] & ~transitions.done[:, :-1] & (before > 0) & (after > 0) & jnp.isfinite(after)
    before = jnp.minimum(before, jnp.finfo(before.dtype).max)
    growth = jnp.log(jnp.where(counts, before, 1.0)) - jnp.log(jnp.where(counts, after, 1.0))
    return jnp.where(counts.any(), jnp.sum(growth) / jnp.maximum(jnp.sum(counts), 1), jnp.nan)
