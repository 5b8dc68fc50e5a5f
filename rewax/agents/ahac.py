"""AHAC, adaptive-horizon actor-critic: SHAC whose horizon shrinks where the gradient grows too fast.

Source: Georgiev et al. 2024, "Adaptive Horizon Actor-Critic for Policy Learning in Contact-Rich Differentiable
Simulation" (ICML 2024). Different:

- They bound the stiffness of the dynamics, by contact forces over accelerations. Here it is read off the backward pass
  of any environment: the logarithm of how much the gradient of the state grows over a step.
- One horizon for all environments moves along the mean excess of that growth (an earlier rule of the authors), instead
  of by a multiplier for each step.
- The rollout always computes ``horizon`` steps; beyond the adaptive horizon the environments stand still.
- Critics are fitted for a fixed number of passes over all samples at once: parts of the time beyond the horizon would
  hold nothing.
"""

import dataclasses

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import Combination, FirstOrderConfig, SHACPolicyConfig, check_count, check_positive
from rewax.agents.episodes import episode_metrics
from rewax.agents.first_order import (
    FirstOrderState,
    Stretch,
    actor_step,
    critic_update,
    start_actor_critic,
    stretch_loss,
)
from rewax.agents.gradients import per_env_gradients
from rewax.agents.rollout import Transition, rollout
from rewax.agents.run_state import advanced, fields
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class AHACConfig(SHACPolicyConfig, FirstOrderConfig):
    """Hyper-parameters beyond those of ``FirstOrderConfig``.

    Attributes:
      horizon: the longest.
      min_horizon, initial_horizon: the shortest, and that of the first iteration.
      max_growth: of the norm of the state's gradient per control step, above which the horizon shrinks [-].
      horizon_rate: control steps by which the horizon moves per iteration and unit of excess.
      critic_minibatches: 1.
    """

    actor_value: Combination = "min"
    horizon: int = 64
    min_horizon: int = 8
    initial_horizon: int = 32
    max_growth: float = 1.1
    horizon_rate: float = 1.0
    critic_passes: int = 64
    critic_minibatches: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("min_horizon", self.min_horizon)
        for name in ("max_growth", "horizon_rate"):
            check_positive(name, getattr(self, name))
        if self.critic_minibatches != 1:
            raise ValueError(f"critic_minibatches is {self.critic_minibatches}: AHAC fits all samples at once, give 1")
        if not self.min_horizon <= self.initial_horizon <= self.horizon:
            raise ValueError(
                f"min_horizon is {self.min_horizon}, initial_horizon {self.initial_horizon}, horizon {self.horizon}: "
                "give them in this order, the smallest first"
            )

    def steps_in(self, env: Env) -> int:
        """Control steps of one environment in the first iteration; later ones follow the horizon."""
        del env
        return self.initial_horizon


@struct.dataclass
class AHACState(FirstOrderState):
    """Everything a run is; a checkpoint holds just this.

    Attributes:
      horizon: of the next iteration, rounded to whole steps when it is used, shape ().
    """

    horizon: Array


def make_ahac(env: Env, config: AHACConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """AHAC on an environment.

    Args:
      env, randomize: as for ``rewax.agents.actor_critic.actor_agent``.
      config: hyper-parameters.
    """
    config = AHACConfig() if config is None else config
    return actor_agent("ahac", env, config, init=init, train_step=train_step, randomize=randomize)


def init(config: AHACConfig, leaves: EnvLeaves, key: Key) -> AHACState:
    """The state of a run that has not begun."""
    base = start_actor_critic(make_actor_critic(leaves.first(), config), leaves, key)
    return AHACState(**fields(base), horizon=jnp.full((), float(config.initial_horizon)))


def train_step(config: AHACConfig, state: AHACState) -> tuple[AHACState, Metrics]:
    """One iteration: actor, critics, horizon."""
    networks = make_actor_critic(state.environments.env.first(), config)
    key, rollout_key = jax.random.split(state.key)

    def loss(
        params: tuple[PyTree, Array], common: AHACState, env: AutoReset, env_state: State, key: Key
    ) -> tuple[Array, Stretch]:
        return actor_loss(networks, common, params, env, env_state, key)

    params = (state.actor_params, jnp.zeros(config.horizon))
    losses, data, (grads, norms) = per_env_gradients(loss, params, state.common(), state.environments, rollout_key)
    actor, actor_metrics = actor_step(networks, state, losses, grads)
    critics, critic_metrics = critic_update(networks, state, data, data.transitions.reward)
    growth = gradient_growth(norms, data.transitions)
    horizon = state.horizon - config.horizon_rate * (growth - jnp.log(config.max_growth))
    horizon = jnp.clip(horizon, config.min_horizon, config.horizon)

    new = advanced(config, state, data.state, data.transitions, key=key, horizon=horizon, **actor, **critics)
    own = {"horizon": jnp.round(state.horizon), "growth": jnp.exp(growth)}
    return new, {**episode_metrics(state.environments, data.transitions), **own, **actor_metrics, **critic_metrics}


def actor_loss(
    networks: ActorCritic,
    state: AHACState,
    params: tuple[PyTree, Array],
    env: AutoReset,
    env_state: State,
    key: Key,
) -> tuple[Array, Stretch]:
    """Minus the return per step of one environment's stretch of the adaptive horizon.

    Args:
      params: of the actor; and probes, see ``rollout``.

    Gradient: through the simulation; by the probes: norms of the state's gradient.
    """
    (actor_params, probes), config = params, networks.config
    policy = networks.acting(actor_params, state.environments.statistics)
    num_active = jnp.round(state.horizon).astype(jnp.int32)
    end, t = rollout(env, env_state, policy, key, num_active=num_active, probes=probes, **config.rollout_options)
    return stretch_loss(networks, state, end, t, t.reward)


def gradient_growth(norms: Array, transitions: Transition) -> Array:
    """Mean logarithm of the factor by which the state's gradient grows backwards over a control step, shape ().

    Args:
      norms: of the gradient by the state that each step starts from, shape (num_envs, T).
      transitions: leading axes (num_envs, T). Steps that end an episode pass no gradient on and do not count.
    """
    before, after = norms[:, :-1], norms[:, 1:]
    counts = transitions.active[:, 1:] & ~transitions.done[:, :-1] & (before > 0) & (after > 0)
    counts = counts & jnp.isfinite(before) & jnp.isfinite(after)
    growth = jnp.log(jnp.where(counts, before, 1.0)) - jnp.log(jnp.where(counts, after, 1.0))
    return jnp.sum(growth) / jnp.maximum(jnp.sum(counts), 1)
