"""Base of all tasks: reset and control step, composed of methods that a kind of physics and a task define."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.base import ArraySpec, State, first_state, next_state
from rewax.envs.kit.checks import (
    check_key,
    checked_action,
    checked_next_task,
    checked_observation,
    checked_reward,
    checked_terminated,
)
from rewax.envs.kit.options import integer_option
from rewax.envs.kit.task_repr import task_repr
from rewax.physics.contact import Patches
from rewax.physics.numerics.checks import shown
from rewax.physics.numerics.clipping import clipped
from rewax.sensors.camera import Camera
from rewax.types import Array, Key, Observation, PyTree

_COUNTS = {
    "num_substeps": "give the number of substeps in a control step",
    "max_steps": "give the number of control steps in an episode",
}


class Task(struct.Replaceable):
    """Base of ``RigidTask``, ``SoftTask`` and ``CoupledTask``, which add fields, ``begin``, ``advance`` and pictures.

    Their physics has the fields ``action``, ``task`` and ``felt``. With the field ``touch``, patches of bodies by the
    name of a sensor, ``felt`` holds the mean force and torque on them in the last control step; without it, None.
    """

    num_substeps: int
    max_steps: int
    touch: dict[str, Patches] | None

    def __post_init__(self) -> None:
        for name in ("num_substeps", "max_steps"):
            integer_option(name, getattr(self, name), _COUNTS[name])
        touch = {} if self.touch is None else self.touch
        if not isinstance(touch, dict) or not all(isinstance(felt, Patches) for felt in touch.values()):
            raise ValueError(f"touch is {shown(self.touch)}: give None, and wrap the task in Sensing with a Touch")

    # --- Methods that a task defines ---

    def observe(self, physics: Any) -> Observation:
        """Named observations of a state."""
        raise NotImplementedError(f"{type(self).__name__} has no observe(physics): define it")

    def reward(self, physics: Any) -> tuple[Array, dict[str, Array]]:
        """Reward of the step that led to a state, shape (), and scalars to log, by name."""
        raise NotImplementedError(f"{type(self).__name__} has no reward(physics): define it")

    def terminated(self, physics: Any) -> Array:
        """Whether the episode ends with value 0 in a state, shape (), bool."""
        del physics
        return jnp.zeros((), bool)

    def next_task(self, physics: Any, key: Key) -> PyTree:
        """The value of ``physics.task`` after a step: a goal that changes, for example.

        ``reward`` and ``terminated`` of the step see the value before, ``observe`` the one after.
        """
        del key
        return physics.task

    @property
    def camera(self) -> dict[str, Any]:
        """Camera of pictures; ``rewax.viz.camera.frame_recording`` lists the keys, all optional."""
        return {}

    camera_body: ClassVar[int | None] = None

    @property
    def default_camera(self) -> Camera | None:
        """The camera of ``make(..., sensors=("camera",))``; None: one that shows all of the first state.

        The body ``camera_body`` then carries it, unless that is None.
        """
        return None

    # --- Methods that a kind of physics defines ---

    @property
    def feeling_bodies(self) -> dict[str, int]:
        """Bodies that can feel contact, by name; ``contact.WALLS`` for walls and ground."""
        raise NotImplementedError(f"{type(self).__name__} has no feeling_bodies: define it")

    @property
    def num_actions(self) -> int:
        """Number of components of an action."""
        raise NotImplementedError(f"{type(self).__name__} has no num_actions: define it")

    def begin(self, key: Key) -> tuple[Any, Key]:
        """Physics at the beginning of an episode, and an unused key."""
        raise NotImplementedError(f"{type(self).__name__} has no begin(key): define it")

    def advance(self, physics: Any, action: Array) -> tuple[Any, Array]:
        """Physics after a control step, and status bits. The action lies within [-1, 1]."""
        raise NotImplementedError(f"{type(self).__name__} has no advance(physics, action): define it")

    def seen(self, physics: Any, key: Key) -> tuple[Observation, Key]:
        """The observation of a state, and an unused key."""
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

    def __repr__(self) -> str:
        return task_repr(self)

    def reset(self, key: Key) -> State:
        """The first state of an episode.

        Raises:
          ValueError: the argument is no random key, or an array of keys.
        """
        check_key(key)
        physics, key = self.begin(key)
        obs, key = self.seen(physics, key)
        return first_state(physics=physics, obs=obs, metrics=checked_reward(self, self.reward(physics))[1], key=key)

    def step(self, state: State, action: Array) -> State:
        """The state after one control step.

        Gradient: exact, through contacts; zero with respect to components of the action beyond [-1, 1].

        Raises:
          ValueError: the action has another shape than ``action_spec``, or holds no real numbers; or a method of the
            task returned something else than its description says.
        """
        action = clipped(checked_action(action, self.action_spec), -1.0, 1.0).astype(state.physics.action.dtype)
        physics, status = self.advance(state.physics, action)
        reward, metrics = checked_reward(self, self.reward(physics))
        terminated = checked_terminated(self, self.terminated(physics))
        key = state.key
        if physics.task is not None:
            key, task_key = jax.random.split(key)
            new = checked_next_task(self, self.next_task(physics, task_key), physics.task)
            physics = physics.replace(task=new)
        obs, key = self.seen(physics, key)
        return next_state(
            state.replace(key=key),
            physics=physics,
            obs=obs,
            reward=reward,
            metrics=metrics,
            episode_length=self.max_steps,
            terminated=terminated,
            status=status,
        )


def against(gravity: Array, default: tuple[float, float, float]) -> np.ndarray:
    """Unit vector opposite to gravity, shape (3,); ``default`` if gravity is zero."""
    pull = np.asarray(gravity, float)
    strength = np.linalg.norm(pull)
    return -pull / strength if strength > 0.0 else np.asarray(default)
