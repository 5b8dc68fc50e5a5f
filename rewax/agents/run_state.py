"""The state of a run: what every algorithm's has, and how it begins."""

import dataclasses
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp

from rewax import struct
from rewax.agents.actor_critic import Actor
from rewax.agents.config import RunConfig
from rewax.agents.environments import Environments, start_environments
from rewax.agents.rollout import Transition
from rewax.envs.base import State
from rewax.envs.leaves import EnvLeaves
from rewax.types import Array, Key, Observation, PyTree


@struct.dataclass
class RunState(struct.Replaceable):
    """Everything a run is; a checkpoint holds just this.

    Attributes:
      environments: the environments, with the statistics of their observations.
      key: source of randomness.
      iteration, env_steps: done so far, shape (), int32.
    """

    environments: Environments
    key: Key
    iteration: Array
    env_steps: Array

    def common(self) -> Self:
        """What all environments share, without what each has of its own."""
        return self.replace(environments=self.environments.common())


@struct.dataclass
class PolicyState(RunState):
    """That of an algorithm with a policy network.

    Attributes:
      actor_params, actor_opt: of the policy and its optimizer.
    """

    actor_params: PyTree
    actor_opt: PyTree


class RunKeys(NamedTuple):
    """Keys for the parts of a run's first state."""

    run: Key
    actor: Key
    critics: Key
    environments: Key
    stagger: Key


def run_keys(key: Key) -> RunKeys:
    """Independent keys from the key of a run."""
    return RunKeys(*jax.random.split(key, 5))


def start_run(config: RunConfig, leaves: EnvLeaves, keys: RunKeys) -> RunState:
    """Environments at the beginning, nothing learnt."""
    environments = start_environments(
        leaves,
        keys.environments,
        keys.stagger,
        num_envs=config.num_envs,
        stagger=getattr(config, "stagger_episodes", False),
        learn_statistics=getattr(config, "normalize_observations", False),
    )
    zero = jnp.zeros((), jnp.int32)
    return RunState(environments=environments, key=keys.run, iteration=zero, env_steps=zero)


def start_policy(actor: Actor, leaves: EnvLeaves, keys: RunKeys) -> PolicyState:
    """The same, with a policy that has not learnt anything."""
    base = start_run(actor.config, leaves, keys)
    actor_params = actor.network.init(keys.actor, first_observation(base))
    return PolicyState(**fields(base), actor_params=actor_params, actor_opt=actor.actor_optimizer.init(actor_params))


def first_observation(state: RunState) -> Observation:
    """Of the first environment; networks are initialised with it."""
    return jax.tree.map(lambda a: a[0], state.environments.state.obs)


def fields(state: Any) -> dict[str, Any]:
    """The fields of a state by name, to build one of a subclass from."""
    return {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}


def advanced(config: RunConfig, state: Any, end: State, transitions: Transition, **changes: Any) -> Any:
    """The state after an iteration: environments moved on, counters raised, and what ``changes`` names.

    Args:
      config, state: of the run.
      end: of the environments after the rollout, leading axis (num_envs,).
      transitions: of the rollout, leading axes (num_envs, horizon).
    """
    environments = state.environments.advanced(
        end, transitions, learn_statistics=getattr(config, "normalize_observations", False)
    )
    steps = jnp.sum(transitions.active, dtype=jnp.int32)
    return state.replace(
        environments=environments, iteration=state.iteration + 1, env_steps=state.env_steps + steps, **changes
    )
