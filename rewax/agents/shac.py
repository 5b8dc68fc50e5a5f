"""SHAC, short-horizon actor-critic: first-order reinforcement learning without entropy.

One iteration: every environment acts for a short horizon; the return of that stretch plus the value at its end is
differentiated through the simulation into the actor; critics follow.

Source: Xu et al. 2022, "Accelerated Policy Learning with Parallel Differentiable Simulation" (ICLR 2022), with the
settings that Xing, Luk and Oh 2025 compare SAPO with (layer norm before the activation, one Adam step per iteration)
and the corrections named in ``rewax.agents.sapo``.
"""

import dataclasses

import jax

from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import FirstOrderConfig, SHACPolicyConfig
from rewax.agents.episodes import episode_metrics
from rewax.agents.first_order import (
    FirstOrderState,
    Stretch,
    actor_update,
    critic_update,
    start_actor_critic,
    stretch_loss,
)
from rewax.agents.rollout import rollout
from rewax.agents.run_state import advanced
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class SHACConfig(SHACPolicyConfig, FirstOrderConfig):
    """Hyper-parameters of ``FirstOrderConfig``; the defaults are those of SAPO's paper for the deformable tasks."""

    num_critics: int = 1
    target_decay: float | None = 0.995


def make_shac(env: Env, config: SHACConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """SHAC on an environment.

    Args:
      env, randomize: as for ``rewax.agents.actor_critic.actor_agent``.
      config: hyper-parameters.
    """
    config = SHACConfig() if config is None else config
    return actor_agent("shac", env, config, init=init, train_step=train_step, randomize=randomize)


def init(config: SHACConfig, leaves: EnvLeaves, key: Key) -> FirstOrderState:
    """The state of a run that has not begun."""
    return start_actor_critic(make_actor_critic(leaves.first(), config), leaves, key)


def train_step(config: SHACConfig, state: FirstOrderState) -> tuple[FirstOrderState, Metrics]:
    """One iteration: actor, critics."""
    networks = make_actor_critic(state.environments.env.first(), config)
    key, rollout_key = jax.random.split(state.key)

    def loss(
        actor_params: PyTree, common: FirstOrderState, env: AutoReset, env_state: State, key: Key
    ) -> tuple[Array, Stretch]:
        return actor_loss(networks, common, actor_params, env, env_state, key)

    actor, data, actor_metrics = actor_update(networks, state, loss, rollout_key)
    critics, critic_metrics = critic_update(networks, state, data, data.transitions.reward)

    new = advanced(config, state, data.state, data.transitions, key=key, **actor, **critics)
    episodes = episode_metrics(state.environments, data.transitions)
    return new, {**episodes, **actor_metrics, **critic_metrics}


def actor_loss(
    networks: ActorCritic, state: FirstOrderState, actor_params: PyTree, env: AutoReset, env_state: State, key: Key
) -> tuple[Array, Stretch]:
    """Minus the return per step of one environment's stretch. Gradient: through the simulation."""
    policy = networks.acting(actor_params, state.environments.statistics)
    end, transitions = rollout(env, env_state, policy, key, **networks.config.rollout_options)
    return stretch_loss(networks, state, end, transitions, transitions.reward)
