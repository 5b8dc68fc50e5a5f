"""What all tasks share: reset and control step in terms of what a kind of physics, and then a task, define."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.base import ArraySpec, State, first_state, next_state
from rewax.envs.kit.checks import check_action, check_key, checked_observation, checked_reward
from rewax.types import Array, Key, Observation, PyTree


class Task(struct.Replaceable):
    """Base of ``RigidTask``, ``SoftTask`` and ``CoupledTask``, which add fields, ``begin``, ``advance`` and pictures.

    Their physics has the fields ``action`` and ``task``.
    """

    num_substeps: int
    max_steps: int

    def __post_init__(self) -> None:
        for name in ("num_substeps", "max_steps"):
            value = getattr(self, name)
            if not isinstance(value, (int, np.integer)) or value < 1:
                raise ValueError(f"{name} is {value}: give a whole number, at least 1")

    # --- What a task defines ---

    def observe(self, physics: Any) -> Observation:
        """Named observations of a state."""
        raise NotImplementedError(f"{type(self).__name__} has no observe(physics): define it")

    def reward(self, physics: Any) -> tuple[Array, dict[str, Array]]:
        """Reward of the step that led to a state, shape (), and named scalars to log."""
        raise NotImplementedError(f"{type(self).__name__} has no reward(physics): define it")

    def terminated(self, physics: Any) -> Array:
        """Whether the episode ends for good, shape (), bool."""
        del physics
        return jnp.zeros((), bool)

    def next_task(self, physics: Any, key: Key) -> PyTree:
        """What the task keeps, after a step."""
        del key
        return physics.task

    @property
    def camera(self) -> dict[str, Any]:
        """How pictures look at the task; ``rewax.viz.camera.frame_recording`` has the keys, all optional."""
        return {}

    # --- What a kind of physics defines ---

    @property
    def num_actions(self) -> int:
        """Components of an action."""
        raise NotImplementedError(f"{type(self).__name__} has no num_actions: define it")

    def begin(self, key: Key) -> tuple[Any, Key]:
        """Physics at the beginning of an episode, and a key that was not used."""
        raise NotImplementedError(f"{type(self).__name__} has no begin(key): define it")

    def advance(self, physics: Any, action: Array) -> tuple[Any, Array]:
        """Physics a control step later, and status bits; the action lies within [-1, 1]."""
        raise NotImplementedError(f"{type(self).__name__} has no advance(physics, action): define it")

    def seen(self, physics: Any, key: Key) -> tuple[Observation, Key]:
        """What a policy sees, and a key that was not used."""
        return checked_observation(self, self.observe(physics)), key

    # --- The environment ---

    @property
    def observation_spec(self) -> dict[str, ArraySpec]:
        state = jax.eval_shape(self.reset, jax.random.key(0))
        return {name: ArraySpec(tuple(value.shape)) for name, value in state.obs.items()}

    @property
    def action_spec(self) -> ArraySpec:
        return ArraySpec((self.num_actions,), -1.0, 1.0)

    @property
    def episode_length(self) -> int:
        return self.max_steps

    def reset(self, key: Key) -> State:
        """The beginning of an episode.

        Raises:
          ValueError: the key is no random key, or several.
        """
        check_key(key)
        physics, key = self.begin(key)
        obs, key = self.seen(physics, key)
        return first_state(physics=physics, obs=obs, metrics=checked_reward(self, self.reward(physics))[1], key=key)

    def step(self, state: State, action: Array) -> State:
        """One control step. Gradient: exact, through contacts; zero by components of the action beyond [-1, 1].

        Raises:
          ValueError: the action has another shape than ``action_spec``.
        """
        check_action(action, self.action_spec)
        action = jnp.clip(action, -1.0, 1.0).astype(state.physics.action.dtype)
        physics, status = self.advance(state.physics, action)
        reward, metrics = checked_reward(self, self.reward(physics))
        key = state.key
        if physics.task is not None:
            key, task_key = jax.random.split(key)
            physics = physics.replace(task=self.next_task(physics, task_key))
        obs, key = self.seen(physics, key)
        return next_state(
            state.replace(key=key),
            physics=physics,
            obs=obs,
            reward=reward,
            metrics=metrics,
            episode_length=self.max_steps,
            terminated=self.terminated(physics),
            status=status,
        )


def against(gravity: Array, default: tuple[float, float, float]) -> np.ndarray:
    """Unit vector against gravity, shape (3,); the default without gravity."""
    pull = np.asarray(gravity, float)
    strength = np.linalg.norm(pull)
    return -pull / strength if strength > 0.0 else np.asarray(default)
