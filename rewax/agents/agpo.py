"""SAPO whose actor leaves the simulation's gradient for that of the critics where it varies too much.

At every step of a rollout the gradient with respect to the next state is ``share`` times the simulation's, through the
rest of the rollout, plus ``1 - share`` times that of the critics' value of that state. If the critics are right, the
expectation is that of SAPO for every share. The last step of a rollout has one step of simulation and the critics
behind it alone; where environments begin a rollout anywhere in their episodes, its variance is that of the critics'
gradient at any step. The share is ``max_ratio`` times that variance over the variance at the step, at most 1.

Source: after Gao et al. 2024, "Adaptive-Gradient Policy Optimization" (ICML 2024), which goes over from the
simulation's gradient to that of a critic where a batch of gradients varies much. Different:

- The critics are SAPO's of states, which take one step of simulation to give the gradient of an action; theirs is of
  states and actions.
- A share between 0 and 1 instead of a choice, for each step of a rollout instead of each transition.
- The variance is that of earlier iterations, of the gradient with respect to the actions as it was mixed there.
- Everything else is SAPO's.
"""

import dataclasses
import functools
from typing import TypeAlias

import jax
import jax.numpy as jnp

from rewax.agents import sapo
from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.first_order import Rollout, combined, rollout_loss
from rewax.agents.ivw import IVWState, check_entropy_of_steps, discounts, measured_actor_update, start
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
      max_ratio: of the variances of the simulation's and the critics' gradients, above which the share falls.
      variance_decay: share that the running mean of the variances keeps each iteration.
    """

    max_ratio: Positive = 10.0
    variance_decay: Share = 0.9

    def __post_init__(self) -> None:
        super().__post_init__()
        check_entropy_of_steps(self)
        if self.truncate_every is not None or self.state_gradient_decay != 1.0:
            raise ValueError(
                f"truncate_every is {self.truncate_every}, state_gradient_decay {self.state_gradient_decay}: give None "
                "and 1, the shares cut the gradient of the state"
            )


Networks: TypeAlias = ActorCritic[AGPOConfig]


def make_agpo(env: Env, config: AGPOConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """SAPO with mixed gradients; arguments as for ``rewax.agents.actor_critic.actor_agent``."""
    config = AGPOConfig() if config is None else config
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
      params: of the actor; and zeros that are added to the actions, shape (horizon, action_size).

    Gradient: at each step the share of the simulation's, and the critics' for the rest.
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
    """Discounted values of the states within segments, each times its share; the discount starts with each segment.

    Args:
      v_tp1: value of the state each step leads to, shape (T,).
      share_t: of that value, shape (T,).
      done_t, valid_t: see ``rewax.agents.returns.short_horizon_return``, which has the values at the ends of segments.

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
    """Share of the simulation's gradient in that of the state which each step starts from, shape (T,).

    Args:
      variance: of each step's discounted gradient, shape (T,). A step without variance has the share 1.
    """
    undiscounted = variance / discounts(config) ** 2
    allowed = config.max_ratio * undiscounted[-1]
    return jnp.where(undiscounted > allowed, allowed / jnp.where(undiscounted > 0, undiscounted, 1.0), 1.0)
