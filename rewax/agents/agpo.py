"""SAPO that mixes the simulation's gradient with that of the critics, where the simulation's varies too much.

At every step of a rollout, the gradient with respect to the next state is a weighted sum. ``share`` weighs the
gradient through the rest of the simulated rollout, ``1 - share`` the gradient of the critics' value of the next state.
If the critics are exact and observations tell the whole state, the expectation does not depend on the share. What is
not observed, for instance an action that ``Latency`` delays, has no gradient in the critics' part.

The gradient of the last step of a rollout flows through one step of simulation and the critics. Its variance serves as
the variance of the critics' gradient at every step. This assumes that environments begin rollouts at random times of
their episodes. The share of step t is min(1, ``max_ratio`` * variance of the last step / variance of step t).

Source: after Gao et al. 2024, "Adaptive-Gradient Policy Optimization" (ICML 2024). Their method replaces the
simulation's gradient by that of a critic where a batch of gradients varies much. Differences:

- The critics are SAPO's state values, which need one step of simulation to give the gradient of an action. Theirs are
  action values.
- Each step of a rollout has a share between 0 and 1. Theirs is a choice for each transition.
- The variance comes from earlier iterations. It is that of the mixed gradient with respect to the actions.
- Everything else is SAPO's.
"""

import dataclasses
import functools
from typing import ClassVar, TypeAlias

import jax
import jax.numpy as jnp

from rewax.agents import sapo
from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import no_memory
from rewax.agents.first_order import Rollout, combined, rollout_loss
from rewax.agents.ivw import IVWState, check_measurable, discounts, measured_actor_update, start
from rewax.agents.legal import Positive, Share
from rewax.agents.returns import segment_ends
from rewax.agents.rollout import rollout
from rewax.agents.sapo import SAPOConfig
from rewax.envs.base import Env, State
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, Observation, PyTree


@dataclasses.dataclass(frozen=True, kw_only=True)
class AGPOConfig(SAPOConfig):
    """Hyper-parameters beyond SAPO's.

    Attributes:
      max_ratio: ratio of the variance at a step to that of the critics' gradient; above it the share falls below 1.
      variance_decay: decay of the running mean of the variances per iteration.
    """

    extends: ClassVar[str] = "sapo_agpo"
    max_ratio: Positive = 10.0
    variance_decay: Share = 0.9

    def __post_init__(self) -> None:
        super().__post_init__()
        no_memory("AGPO mixes gradients of states, of which a memory is none").check("memory", self.memory)
        check_measurable(self)
        if self.truncate_every is not None or self.state_gradient_decay != 1.0:
            raise ValueError(
                f"truncate_every is {self.truncate_every}, state_gradient_decay {self.state_gradient_decay}: give None "
                "and 1, because the shares scale the gradient of the state"
            )


Networks: TypeAlias = ActorCritic[AGPOConfig]


def make_agpo(env: Env, config: AGPOConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """SAPO with mixed gradients; arguments as for ``rewax.agents.actor_critic.actor_agent``."""
    config = AGPOConfig.given(config)
    return actor_agent("sapo_agpo", env, config, init=start, train_step=train_step, randomize=randomize)


def train_step(config: AGPOConfig, state: IVWState) -> tuple[IVWState, Metrics]:
    """One iteration: actor, variances, temperature, critics."""
    networks = make_actor_critic(state.environments.env.first(), config)
    key, rollout_key = jax.random.split(state.key)
    own = {"simulation_share": simulation_shares(config, state.variance).mean()}
    loss = functools.partial(actor_loss, networks=networks)

    decay = config.variance_decay
    state, actor_metrics, rollouts = measured_actor_update(networks, state, loss, rollout_key, decay=decay)
    state, metrics = sapo.after_actor(networks, state, rollouts, key)
    return state, {**metrics, **own, **actor_metrics}


def actor_loss(
    params: tuple[PyTree, Array], common: IVWState, env: AutoReset, env_state: State, key: Key, *, networks: Networks
) -> tuple[Array, Rollout]:
    """Minus the soft return per step of one environment's rollout.

    Args:
      params: the actor's parameters, and zeros of shape (horizon, action_size) that are added to the actions.

    Gradient: at each step ``share`` times the simulation's plus ``1 - share`` times the critics'.
    """
    (actor_params, nudges), config, statistics = params, networks.config, common.environments.statistics
    soft_policy = sapo.soft_policy(networks, actor_params, statistics)

    def policy(obs: Observation, key: Key, nudge: Array) -> tuple[Array, dict[str, Array]]:
        action, aux = soft_policy(obs, key)
        return action + nudge, aux

    shares = simulation_shares(config, common.variance)
    flow = {"differentiate": config.differentiate, "state_gradient_decay": shares}
    end, t = rollout(env, env_state, policy, key, horizon=config.horizon, inputs=nudges, **flow)
    soft = sapo.bonus(networks, common.log_temperature, t.aux["entropy"]) if config.entropy_in_return else 0.0
    loss, rollouts = rollout_loss(networks, common, end, t, t.reward + soft)

    value = combined(rollouts.next_values, config.actor_value)
    rest = critic_part(value, jnp.append(1.0 - shares[1:], 0.0), t.done, t.valid, discount=config.discount)
    return loss - (rest - jax.lax.stop_gradient(rest)) / jnp.sum(t.active), rollouts


def critic_part(v_tp1: Array, share_t: Array, done_t: Array, valid_t: Array, *, discount: float) -> Array:
    """Sum of discounted values of the states inside segments, each times its share. The discount restarts per segment.

    ``rewax.agents.returns.short_horizon_return`` adds the values at the ends of segments.

    Args:
      v_tp1: value of the state that step t leads to, shape (T,).
      share_t: weight of that value, shape (T,).
      done_t, valid_t: see ``short_horizon_return``.

    Returns:
      The sum, shape (). Gradient: exact.
    """

    def forward(weight: Array, inputs: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        value, share, end, valid = inputs
        gained = jnp.where(end | ~valid, 0.0, weight * discount * share * value)
        return jnp.where(end, 1.0, weight * discount), gained

    steps = (v_tp1, share_t, segment_ends(done_t, valid_t), valid_t)
    return jax.lax.scan(forward, jnp.ones_like(v_tp1[0]), steps)[1].sum()


def simulation_shares(config: AGPOConfig, variance: Array) -> Array:
    """Weight of the simulation's gradient in the gradient of state t, shape (T,).

    Args:
      variance: variance of each step's discounted gradient, shape (T,). A step with variance 0 has the share 1.
        Behind a latency the last actions have no effect within the rollout, so the last step with a variance above 0
        tells the critics'.
    """
    undiscounted = variance / discounts(config) ** 2
    last = jnp.max(jnp.where(undiscounted > 0, jnp.arange(len(variance)), 0))
    allowed = config.max_ratio * undiscounted[last]
    return jnp.where(undiscounted > allowed, allowed / jnp.where(undiscounted > 0, undiscounted, 1.0), 1.0)
