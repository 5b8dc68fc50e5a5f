"""APG, analytic policy gradient: the gradient of the rewards alone, through the simulation, without a value function.

With a short horizon an iteration continues where the last one ended; with whole episodes (``horizon=0``) each iteration
starts from new initial states and differentiates them to their time limit.

Source: Freeman et al. 2021, Brax; Wiedemann et al. 2023, "Training Efficient Controllers via Analytic Policy Gradient";
settings as in Xing, Luk and Oh 2025, with the corrections named in ``rewax.agents.sapo``.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from rewax.agents.actor_critic import Actor, actor_agent, make_actor
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import GradientConfig, SHACPolicyConfig
from rewax.agents.episodes import episode_metrics
from rewax.agents.first_order import actor_update
from rewax.agents.returns import short_horizon_return
from rewax.agents.rollout import Transition, rollout
from rewax.agents.run_state import PolicyState, advanced, run_keys, start_policy
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class APGConfig(SHACPolicyConfig, GradientConfig):
    """Hyper-parameters of its bases; the defaults are those of SAPO's paper."""

    least_horizon: ClassVar[int] = 0


def make_apg(env: Env, config: APGConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """APG on an environment.

    Args:
      env, randomize: as for ``rewax.agents.actor_critic.actor_agent``.
      config: hyper-parameters.
    """
    config = APGConfig() if config is None else config
    return actor_agent("apg", env, config, init=init, train_step=train_step, randomize=randomize, networks=make_actor)


def init(config: APGConfig, leaves: EnvLeaves, key: Key) -> PolicyState:
    """The state of a run that has not begun."""
    return start_policy(make_actor(leaves.first(), config), leaves, run_keys(key))


def train_step(config: APGConfig, state: PolicyState) -> tuple[PolicyState, Metrics]:
    """One iteration."""
    env = state.environments.env.first()
    actor, horizon = make_actor(env, config), config.steps_in(env)
    key, rollout_key, reset_key = jax.random.split(state.key, 3)
    if config.horizon == 0:
        state = state.replace(environments=state.environments.restarted(reset_key))

    def loss(actor_params: PyTree, common: PolicyState, env: AutoReset, env_state: State, key: Key):
        return actor_loss(actor, common, actor_params, env, env_state, key, horizon)

    changes, (end, transitions), actor_metrics = actor_update(actor, state, loss, rollout_key)
    new = advanced(config, state, end, transitions, key=key, **changes)
    return new, {**episode_metrics(state.environments, transitions), **actor_metrics}


def actor_loss(
    actor: Actor, state: PolicyState, actor_params: PyTree, env: AutoReset, env_state: State, key: Key, horizon: int
) -> tuple[Array, tuple[State, Transition]]:
    """Minus the return per step of one environment's stretch. Gradient: through the simulation."""
    config, policy = actor.config, actor.acting(actor_params, state.environments.statistics)
    end, t = rollout(env, env_state, policy, key, **{**config.rollout_options, "horizon": horizon})
    objective = short_horizon_return(t.reward, jnp.zeros_like(t.reward), t.done, t.valid, discount=config.discount)
    return -objective / horizon, (end, t)
