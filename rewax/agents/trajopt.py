"""TrajOpt, trajectory optimisation: one open-loop sequence of actions for all initial states.

One iteration: every environment plays the sequence from a new initial state to its end. The undiscounted return is
differentiated through the whole episode with respect to the actions.

Source: the baseline of Xing, Luk and Oh 2025, an open-loop sequence that maximises the total reward over environments
with Adam. The actions are clipped to their bounds after each update, because beyond the bounds the gradient is zero.
"""

import dataclasses
import functools
from typing import Annotated, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import optax

from rewax import struct
from rewax.agents.base import Agent, Metrics, bind
from rewax.agents.config import GradientOptions, RunConfig, no_memory
from rewax.agents.episodes import episode_metrics
from rewax.agents.gradients import mean_gradient, per_env_gradients
from rewax.agents.legal import Decay, Positive
from rewax.agents.optimizers import apply
from rewax.agents.rollout import Transition, first_episode, rollout
from rewax.agents.run_state import RunState, partition, run_keys, start_environments
from rewax.envs.base import Env, State
from rewax.envs.leaves import EnvLeaves
from rewax.envs.randomized import Randomize
from rewax.envs.wrappers import AutoReset
from rewax.types import Array, Key, Observation, PyTree

S = TypeVar("S", bound=RunState)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrajOptConfig(GradientOptions, RunConfig):
    """Hyper-parameters.

    Attributes:
      horizon: must be 0, for whole episodes.
      learning_rate, adam_b1, adam_b2: settings of Adam.
      memory: must be 0: a sequence of actions observes nothing.
    """

    least_horizon: ClassVar[int] = 0
    horizon: int = 0
    num_iterations: int = 50
    learning_rate: Positive = 1e-2
    adam_b1: Decay = 0.9
    adam_b2: Decay = 0.999
    memory: Annotated[int, no_memory("TrajOpt learns a sequence of actions, which observes nothing")] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.horizon != 0:
            raise ValueError(f"horizon is {self.horizon}: TrajOpt plays whole episodes, give 0")

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """The optimizer of the sequence."""
        return optax.adam(self.learning_rate, self.adam_b1, self.adam_b2)


@struct.dataclass
class TrajOptState(RunState):
    """The complete state of a run; this is what a checkpoint stores.

    Attributes:
      actions: the sequence, shape (episode_length, action_size).
      opt_state: state of the optimizer.
    """

    actions: Array
    opt_state: PyTree


def make_trajopt(env: Env, config: TrajOptConfig | None = None, *, randomize: Randomize | None = None) -> Agent:
    """TrajOpt on an environment.

    Args:
      env: one environment without auto-reset, or a batch of ``num_envs`` environments (``rewax.envs.stack``).
      config: hyper-parameters.
      randomize: ``(key, env) -> env``, called at each reset to draw new parameters of the environment.

    Returns:
      An agent with ``policy(state, obs, key, deterministic=False, step=0)``. The action depends on ``step`` only.
    """
    config = TrajOptConfig.given(config)
    leaves = partition(env, config.num_envs, randomize)
    return bind("trajopt", config, leaves, init=init, train_step=train_step, policy=policy)


def policy(
    state: TrajOptState, obs: Observation, key: Key, deterministic: bool = False, step: Array | int = 0
) -> Array:
    """The action of a step of the sequence; after its end, the last action."""
    del obs, key, deterministic
    return state.actions[jnp.clip(step, 0, len(state.actions) - 1)]


def init(config: TrajOptConfig, leaves: EnvLeaves, key: Key) -> TrajOptState:
    """The first state of a run. All actions are zero."""
    env, keys = leaves.first(), run_keys(key)
    actions = jnp.zeros((env.episode_length, *env.action_spec.shape))
    environments = start_environments(config, leaves, keys)
    opt_state = config.optimizer.init(actions)
    return TrajOptState(environments=environments, key=keys.run, actions=actions, opt_state=opt_state)


def train_step(config: TrajOptConfig, state: TrajOptState) -> tuple[TrajOptState, Metrics]:
    """One iteration."""
    spec = state.environments.env.first().action_spec
    key, loss_key, reset_key = jax.random.split(state.key, 3)
    state = state.replace(environments=state.environments.restarted(reset_key))

    loss = functools.partial(sequence_loss, config=config)
    losses, data, grads = per_env_gradients(loss, state.actions, state.common(), state.environments, loss_key)
    grad, metrics = mean_gradient(losses, grads, max_norm=config.max_env_grad_norm)
    actions, opt_state = apply(config.optimizer, grad, state.opt_state, state.actions)
    state = state.replace(actions=jnp.clip(actions, spec.low, spec.high), opt_state=opt_state)
    state, of_sequence = after_sequence(config, state, *data, key)
    return state, {**of_sequence, **metrics}


def after_sequence(config: RunConfig, state: S, end: State, transitions: Transition, key: Key) -> tuple[S, Metrics]:
    """``RunState.after``, with metrics of those episodes that began with the sequence."""
    metrics = episode_metrics(state.environments.episode_return, first_episode(transitions))
    return state.after(config, end, transitions, key)[0], metrics


def sequence_loss(
    actions: Array, common: RunState, env: AutoReset, env_state: State, key: Key, *, config: TrajOptConfig
) -> tuple[Array, tuple[State, Transition]]:
    """Minus the undiscounted return of one environment for a sequence of actions. Gradient: through the simulation."""
    del common

    def play(obs: Observation, key: Key, action: Array) -> tuple[Array, dict[str, Array]]:
        del obs, key
        return action, {}

    end, t = rollout(env, env_state, play, key, horizon=len(actions), inputs=actions, **config.gradient_flow)
    own = first_episode(t)
    return -jnp.sum(jnp.where(own.valid, own.reward, 0.0)), (end, t)
