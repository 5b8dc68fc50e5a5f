"""RPO, reparameterisation proximal policy optimisation: several epochs on one differentiated rollout.

One iteration: the return over a short horizon is differentiated once, through the simulation, with respect to every
action. Several epochs reuse these derivatives. Each epoch reparameterises every action under the new policy: mean plus
standard deviation times the noise that reproduces the action. It weights the action by the probability ratio. Samples
with a ratio outside its range are masked. The gradient of the first epoch is SHAC's.

Source: Zhong et al. 2025, "Reparameterization Proximal Policy Optimization" (arXiv 2508.06214). Differences:

- Ratios and derivatives are those of the action before its tanh.
- Adam and the networks are SAPO's.
- The entropy in the objective is that of the normal distribution before the tanh.
- The observation statistics are updated after the epochs.
- With a memory, the gradient of the critics' values by the memory that they see is left out, so the first epoch is
  SHAC's only for critics that do not observe it (``critic_observe``). ``truncate_every`` and ``state_gradient_decay``
  do not act on the memory, which the epochs recompute.
"""

import dataclasses
import functools
from typing import TypeAlias

import jax
import jax.numpy as jnp
import optax

from rewax.agents.actor_critic import ActorCritic, actor_agent, make_actor_critic
from rewax.agents.base import Agent, Metrics
from rewax.agents.config import FirstOrderConfig
from rewax.agents.distributions import TanhNormal
from rewax.agents.first_order import Rollout, critic_update, rollout_loss, start_actor_critic
from rewax.agents.gradients import clip_per_env, finite_per_env, per_env_gradients
from rewax.agents.legal import Count, NonNegative
from rewax.agents.optimizers import apply, finite_or_zero
from rewax.agents.rollout import masked, rollout
from rewax.agents.run_state import ActorCriticState
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.memory import remembered
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, Observation, PyTree

_MAX_LOG_RATIO = 20.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class RPOConfig(FirstOrderConfig):
    """Hyper-parameters beyond those of ``FirstOrderConfig``.

    Attributes:
      max_env_grad_norm: norm to which each environment's derivative by its actions is clipped. Other algorithms clip
        the gradient of the parameters, so the same number is another limit here.
      epochs: updates of the actor per rollout.
      lowest_ratio, highest_ratio: range of the probability ratio; samples outside it are masked.
      kl_coefficient: weight of the KL divergence from the policy that acted.
      entropy_coefficient: weight of the entropy.
    """

    actor_learning_rate: float = 5e-4
    max_grad_norm: float = 1.0
    weight_decay: float = 0.0
    epochs: Count = 5
    lowest_ratio: float = 0.2
    highest_ratio: float = 2.0
    kl_coefficient: NonNegative = 0.2
    entropy_coefficient: NonNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.lowest_ratio < 1.0 < self.highest_ratio:
            raise ValueError(
                f"lowest_ratio is {self.lowest_ratio} and highest_ratio {self.highest_ratio}: give numbers below and "
                "above 1"
            )


Networks: TypeAlias = ActorCritic[RPOConfig]


def make_rpo(env: Env, config: RPOConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """RPO on an environment; arguments as for ``rewax.agents.actor_critic.actor_agent``."""
    config = RPOConfig.given(config)
    return actor_agent("rpo", env, config, init=init, train_step=train_step, randomize=randomize)


def init(config: RPOConfig, leaves: EnvLeaves, key: Key) -> ActorCriticState:
    """The first state of a run."""
    networks = make_actor_critic(leaves.first(), config)
    state = start_actor_critic(ActorCriticState, networks, leaves, key)
    return state.replace(actor_opt=actor_optimizer(networks).init(state.actor_params))


def train_step(config: RPOConfig, state: ActorCriticState) -> tuple[ActorCriticState, Metrics]:
    """One iteration: derivatives with respect to actions, epochs of the actor, critics."""
    networks = make_actor_critic(state.environments.env.first(), config)
    key, rollout_key = jax.random.split(state.key)
    loss = functools.partial(shifted_loss, networks=networks)

    # All environments share the zeros; each environment's gradient is with respect to its own actions.
    shift = jnp.zeros((config.horizon, networks.action_size))
    losses, rollouts, by_action = per_env_gradients(loss, shift, state.common(), state.environments, rollout_key)
    if config.max_env_grad_norm is not None:
        by_action = clip_per_env(by_action, config.max_env_grad_norm)
    finite = finite_per_env(losses, by_action)
    state, actor_metrics = actor_epochs(networks, state, rollouts, by_action, finite)
    state, critic_metrics = critic_update(networks, state, rollouts, rollouts.transitions.reward)

    state, episode_metrics = state.after(config, rollouts.end, rollouts.transitions, key)
    own = {"actor_loss": _mean(losses, finite), "dropped_gradients": jnp.sum(~finite)}
    return state, {**episode_metrics, **own, **actor_metrics, **critic_metrics}


def shifted_loss(
    shift: Array, common: ActorCriticState, env: AutoReset, env_state: State, key: Key, *, networks: Networks
) -> tuple[Array, Rollout]:
    """Minus the return per step of one environment.

    ``shift``, shape (T, action_size), is added to the actions before the tanh. Gradient: with respect to ``shift``,
    through the simulation and the policy's later actions.
    """
    config, statistics = networks.config, common.environments.statistics

    def policy(obs: Observation, key: Key, shift: Array) -> tuple[Array, dict[str, Array]]:
        distribution, memory = networks.decide(common.actor_params, networks.normalize(statistics, obs))
        raw = distribution.sample_raw(key) + shift
        return remembered(jnp.tanh(raw), memory), {
            "raw": raw,
            "mean": distribution.mean,
            "log_std": distribution.log_std,
        }

    end, t = rollout(env, env_state, policy, key, horizon=config.horizon, inputs=shift, **config.gradient_flow)
    return rollout_loss(networks, common, end, t, t.reward)


def actor_epochs(
    networks: Networks, state: ActorCriticState, rollouts: Rollout, by_action: Array, finite: Array
) -> tuple[ActorCriticState, Metrics]:
    """Several updates of the actor with the same derivatives.

    Args:
      networks, state: the policy network with its optimizer, and the run.
      rollouts: rollouts, leading axis of environments.
      by_action: derivative of each environment's loss with respect to its actions before the tanh, shape
        (num_envs, T, action_size).
      finite: mask of the environments with finite derivatives, shape (num_envs,).
    """
    optimizer, t = actor_optimizer(networks), rollouts.transitions
    counts = finite[:, None] & t.valid
    obs = networks.normalize(state.environments.statistics, t.obs)
    loss = functools.partial(
        surrogate_loss,
        networks=networks,
        obs=masked(obs, counts),
        aux=masked(t.aux, counts),
        by_action=by_action,
        counts=counts,
        begins=t.begins if networks.config.memory else None,
    )

    def epoch(carry: tuple[PyTree, PyTree], _: None) -> tuple[tuple[PyTree, PyTree], Metrics]:
        params, opt = carry
        grad, metrics = jax.grad(loss, has_aux=True)(params)
        metrics |= {"actor_grad_norm": optax.tree.norm(grad)}
        return apply(optimizer, finite_or_zero(grad), opt, params), metrics

    start = (state.actor_params, state.actor_opt)
    (params, opt), rows = jax.lax.scan(epoch, start, None, length=networks.config.epochs)
    metrics = {name: values.mean() for name, values in rows.items()}
    return state.replace(actor_params=params, actor_opt=opt), {**metrics, "kl": rows["kl"][-1]}


def surrogate_loss(
    params: PyTree,
    *,
    networks: Networks,
    obs: Observation,
    aux: dict[str, Array],
    by_action: Array,
    counts: Array,
    begins: Array | None = None,
) -> tuple[Array, Metrics]:
    """Loss of an epoch: the reused derivatives times the actions, plus the KL divergence, minus the entropy.

    Args:
      params: new parameters of the policy.
      networks: the policy network.
      obs: normalised observations, leading axes (num_envs, T).
      aux: ``raw``, ``mean`` and ``log_std`` of the policy that acted, the same axes.
      by_action: derivative of the loss with respect to the actions before the tanh, the same axes.
      counts: mask of the samples to use, shape (num_envs, T), bool.
      begins: with memory, ``Transition.begins``; the actions are functions of all observations since then.

    Source: Zhong et al. 2025, sections on the surrogate objective, the clipped policy gradient and the KL divergence.
    """
    config = networks.config
    if begins is None:
        now = jax.vmap(jax.vmap(lambda obs: networks.distribution(params, obs)))(obs)
    else:
        now = jax.vmap(functools.partial(networks.distributions, params))(obs, begins)
    before = TanhNormal(mean=aux["mean"], log_std=aux["log_std"])
    log_ratio = jnp.sum(jnp.subtract(now.base.log_prob(aux["raw"]), before.base.log_prob(aux["raw"])), axis=-1)
    ratio = jax.lax.stop_gradient(jnp.exp(jnp.clip(log_ratio, -_MAX_LOG_RATIO, _MAX_LOG_RATIO)))
    kept = counts & (ratio >= config.lowest_ratio) & (ratio <= config.highest_ratio)
    noise = jax.lax.stop_gradient((aux["raw"] - now.mean) * jnp.exp(-now.log_std))
    again = now.mean + jnp.exp(now.log_std) * noise
    # Sum over time, mean over environments: the derivatives are already those of a loss per step.
    along = jnp.sum(jnp.where(counts[..., None], by_action, 0.0) * again, axis=-1)
    gain = jnp.sum(jnp.where(kept, ratio * along, 0.0)) / jnp.maximum(jnp.any(counts, axis=1).sum(), 1)
    kl = _mean(jnp.sum(before.base.kl_divergence(now.base), axis=-1), counts)
    entropy = _mean(jnp.sum(now.base.entropy(), axis=-1), counts)
    metrics = {"kl": kl, "entropy": entropy, "kept": _mean(kept, counts)}
    return gain + config.kl_coefficient * kl - config.entropy_coefficient * entropy, metrics


def _mean(values: Array, counts: Array) -> Array:
    """Mean of the values that count; 0 if none does."""
    return jnp.sum(values, where=counts) / jnp.maximum(jnp.sum(counts), 1)


def actor_optimizer(networks: Networks) -> optax.GradientTransformation:
    """The actor's optimizer: ``epochs`` updates per iteration, with a learning rate that falls linearly."""
    return networks.falling_optimizer(networks.config.actor_learning_rate, networks.config.epochs)
