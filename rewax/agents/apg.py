"""APG, analytic policy gradient: the gradient of the rewards alone, through the simulation, without a value function.

With a short horizon, an iteration continues where the last one ended. With ``horizon=0`` each iteration starts from new
initial states and differentiates whole episodes.

Source: Freeman et al. 2021, Brax; Wiedemann et al. 2023, "Training Efficient Controllers via Analytic Policy Gradient";
settings as in Xing, Luk and Oh 2025, with the differences named in ``rewax.agents.sapo``.
Point-cloud encoders are initialised with ``initial_gain`` (the square root of 2), like all layers. Theirs use 1.
"""

import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp

from rewax.agents.actor_critic import Actor, actor_agent, make_actor
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import Activation, GradientOptions, Optimizer, PolicyConfig
from rewax.agents.first_order import actor_update
from rewax.agents.returns import short_horizon_return
from rewax.agents.rollout import Transition, rollout
from rewax.agents.run_state import PolicyState, run_keys, start_environments
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class APGConfig(PolicyConfig, GradientOptions):
    """The hyper-parameters of its base classes. The defaults are those of SAPO's paper."""

    least_horizon: ClassVar[int] = 0
    optimizer: Optimizer = "adam"
    max_grad_norm: float = 1.0
    activation: Activation = "elu"
    initial_gain: float = 2.0**0.5
    state_dependent_std: bool = False
    initial_log_std: float = -1.0


def make_apg(env: Env, config: APGConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """APG on an environment; arguments as for ``rewax.agents.actor_critic.actor_agent``."""
    config = APGConfig.given(config)
    return actor_agent("apg", env, config, init=init, train_step=train_step, randomize=randomize)


def init(config: APGConfig, leaves: EnvLeaves, key: Key) -> PolicyState:
    """The first state of a run."""
    actor, keys = make_actor(leaves.first(), config), run_keys(key)
    environments = start_environments(config, leaves, keys)
    params = actor.network.init(keys.actor, environments.first_observation())
    opt = actor.actor_optimizer.init(params)
    return PolicyState(environments=environments, key=keys.run, actor_params=params, actor_opt=opt)


def train_step(config: APGConfig, state: PolicyState) -> tuple[PolicyState, Metrics]:
    """One iteration."""
    env = state.environments.env.first()
    actor = make_actor(env, config)
    key, rollout_key, reset_key = jax.random.split(state.key, 3)
    if config.horizon == 0:
        state = state.replace(environments=state.environments.restarted(reset_key))

    loss = functools.partial(actor_loss, actor=actor, horizon=config.steps_in(env))
    state, metrics, (end, t) = actor_update(actor, state, loss, rollout_key, max_norm=config.max_env_grad_norm)
    state, episode_metrics = state.after(config, end, t, key)
    return state, {**episode_metrics, **metrics}


def actor_loss(
    actor_params: PyTree,
    common: PolicyState,
    env: AutoReset,
    env_state: State,
    key: Key,
    *,
    actor: Actor[APGConfig],
    horizon: int,
) -> tuple[Array, tuple[State, Transition]]:
    """Minus the return per step of one environment's rollout. Gradient: through the simulation."""
    config, policy = actor.config, actor.sampling(actor_params, common.environments.statistics)
    end, t = rollout(env, env_state, policy, key, horizon=horizon, **config.gradient_flow)
    objective = short_horizon_return(t.reward, jnp.zeros_like(t.reward), t.done, t.valid, discount=config.discount)
    return -objective / horizon, (end, t)
