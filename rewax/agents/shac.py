"""SHAC, short-horizon actor-critic: first-order reinforcement learning without entropy.

One iteration: every environment acts for a short horizon. The return of that segment plus the value at its end is
differentiated through the simulation with respect to the actor's parameters. Then the critics are updated.

Source: Xu et al. 2022, "Accelerated Policy Learning with Parallel Differentiable Simulation" (ICLR 2022), with the
settings that Xing, Luk and Oh 2025 compare SAPO with (layer norm before the activation, one Adam step per iteration)
and the corrections named in ``rewax.agents.sapo``. Differences from their code:

- The actor's return bootstraps with the critics. Theirs bootstraps with the target network; here the target network is
  used for the critics' targets only.
- The presets of ``small`` have another actor and a faster target network, see ``rewax.agents.presets``.
- Point-cloud encoders are initialised with ``initial_gain`` (the square root of 2), like all layers. Theirs use 1.
"""

import dataclasses
import functools
from typing import TypeAlias

import jax

from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import Activation, FirstOrderConfig, Optimizer
from rewax.agents.first_order import Rollout, actor_update, critic_update, rollout_loss, start_actor_critic
from rewax.agents.rollout import rollout
from rewax.agents.run_state import ActorCriticState
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class SHACConfig(FirstOrderConfig):
    """Hyper-parameters of ``FirstOrderConfig``; the defaults are those of SAPO's paper for the deformable tasks."""

    optimizer: Optimizer = "adam"
    max_grad_norm: float = 1.0
    activation: Activation = "elu"
    initial_gain: float = 2.0**0.5
    state_dependent_std: bool = False
    initial_log_std: float = -1.0
    num_critics: int = 1
    target_decay: float | None = 0.995


Networks: TypeAlias = ActorCritic[SHACConfig]


def make_shac(env: Env, config: SHACConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """SHAC on an environment; arguments as for ``rewax.agents.actor_critic.actor_agent``."""
    config = SHACConfig.given(config)
    return actor_agent("shac", env, config, init=init, train_step=train_step, randomize=randomize)


def init(config: SHACConfig, leaves: EnvLeaves, key: Key) -> ActorCriticState:
    """The first state of a run."""
    return start_actor_critic(ActorCriticState, make_actor_critic(leaves.first(), config), leaves, key)


def train_step(config: SHACConfig, state: ActorCriticState) -> tuple[ActorCriticState, Metrics]:
    """One iteration: actor, critics."""
    networks = make_actor_critic(state.environments.env.first(), config)
    key, rollout_key = jax.random.split(state.key)
    loss = functools.partial(actor_loss, networks=networks)

    state, actor_metrics, rollouts = actor_update(networks, state, loss, rollout_key, max_norm=config.max_env_grad_norm)
    state, critic_metrics = critic_update(networks, state, rollouts, rollouts.transitions.reward)
    state, episode_metrics = state.after(config, rollouts.end, rollouts.transitions, key)
    return state, {**episode_metrics, **actor_metrics, **critic_metrics}


def actor_loss(
    actor_params: PyTree, common: ActorCriticState, env: AutoReset, env_state: State, key: Key, *, networks: Networks
) -> tuple[Array, Rollout]:
    """Minus the return per step of one environment's rollout. Gradient: through the simulation.

    Source: Xu et al. 2022, eq. 5.
    """
    config, policy = networks.config, networks.sampling(actor_params, common.environments.statistics)
    end, transitions = rollout(env, env_state, policy, key, horizon=config.horizon, **config.gradient_flow)
    return rollout_loss(networks, common, end, transitions, transitions.reward)
