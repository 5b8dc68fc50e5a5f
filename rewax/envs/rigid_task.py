"""What tasks on articulated rigid bodies share: reset, control step, time limit, pictures.

A task is a subclass that says how an episode starts, what is observed, what is rewarded and when it is over; see
``examples/custom_rigid_task.py``.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.base import ArraySpec, State, first_state, next_state
from rewax.envs.checks import check_action, check_key
from rewax.physics import rigid
from rewax.physics.rigid import RigidModel, RigidState
from rewax.types import Array, Key, Observation, PyTree

ASSETS = Path(__file__).parent / "assets"
"""MJCF of the tasks that come with rewax."""


@struct.dataclass
class RigidPhysics(struct.Replaceable):
    """What a task on rigid bodies simulates.

    Attributes:
      rigid: positions and velocities of the bodies.
      action: the last one, within [-1, 1]; zero after a reset, shape (num_actions,).
      task: what else the task keeps (a goal, say), or None.
    """

    rigid: RigidState
    action: Array
    task: PyTree = None


@struct.dataclass
class RigidTask(struct.Replaceable):
    """A task on one model. Subclasses define ``start``, ``observe`` and ``reward``, and what else they need.

    Attributes:
      model: bodies, actuators and contact law; its numbers are leaves: differentiate or vmap with respect to them.
      num_substeps: per control step (static).
      max_steps: control steps per episode (static).
    """

    model: RigidModel
    num_substeps: int = struct.static_field()
    max_steps: int = struct.static_field()

    def __post_init__(self) -> None:
        for name in ("num_substeps", "max_steps"):
            value = getattr(self, name)
            if not isinstance(value, (int, np.integer)) or value < 1:
                raise ValueError(f"{name} is {value}: give a whole number, at least 1")

    # --- What a task defines ---

    def start(self, key: Key) -> tuple[RigidState, PyTree]:
        """Bodies at the beginning of an episode, and what else the task keeps (None for nothing)."""
        raise NotImplementedError(f"{type(self).__name__} has no start(key): define it")

    def observe(self, physics: RigidPhysics) -> Observation:
        """Named observations of a state."""
        raise NotImplementedError(f"{type(self).__name__} has no observe(physics): define it")

    def reward(self, physics: RigidPhysics) -> tuple[Array, dict[str, Array]]:
        """Reward of the step that led to a state, shape (), and named scalars to log."""
        raise NotImplementedError(f"{type(self).__name__} has no reward(physics): define it")

    def terminated(self, physics: RigidPhysics) -> Array:
        """Whether the episode ends for good, shape (), bool."""
        del physics
        return jnp.zeros((), bool)

    def control(self, action: Array) -> Array:
        """Controls of the model's actuators for an action within [-1, 1]: from end to end of limited ones' range."""
        limited = self.model.static.mj.actuator_ctrllimited.astype(bool)
        low, high = jnp.moveaxis(self.model.parameters["actuator_ctrlrange"], -1, 0)
        return jnp.where(limited, 0.5 * (low + high) + 0.5 * (high - low) * action, action)

    def next_task(self, physics: RigidPhysics, key: Key) -> PyTree:
        """What the task keeps, after a step."""
        del key
        return physics.task

    # --- The environment ---

    @property
    def observation_spec(self) -> dict[str, ArraySpec]:
        state = jax.eval_shape(self.reset, jax.random.key(0))
        return {name: ArraySpec(tuple(value.shape)) for name, value in state.obs.items()}

    @property
    def action_spec(self) -> ArraySpec:
        return ArraySpec((self.model.num_actuators,), -1.0, 1.0)

    @property
    def episode_length(self) -> int:
        return self.max_steps

    @property
    def control_dt(self) -> float:
        """Duration of a control step [s]."""
        return self.num_substeps * self.model.dt

    def reset(self, key: Key) -> State:
        check_key(key)
        key, start_key = jax.random.split(key)
        bodies, task = self.start(start_key)
        physics = RigidPhysics(rigid=bodies, action=jnp.zeros(self.action_spec.shape, bodies.qpos.dtype), task=task)
        return first_state(physics=physics, obs=self.observe(physics), metrics=self.reward(physics)[1], key=key)

    def step(self, state: State, action: Array) -> State:
        """One control step. Gradient: exact, through contacts; zero by components of the action beyond [-1, 1].

        Raises:
          ValueError: the action has another shape than ``action_spec``.
        """
        check_action(action, self.action_spec)
        action = jnp.clip(action, -1.0, 1.0)
        bodies = rigid.step(self.model, state.physics.rigid, self.control(action), num_substeps=self.num_substeps)
        physics = state.physics.replace(rigid=bodies, action=action.astype(bodies.qpos.dtype))
        reward, metrics = self.reward(physics)
        key = state.key
        if physics.task is not None:
            key, task_key = jax.random.split(key)
            physics = physics.replace(task=self.next_task(physics, task_key))
        return next_state(
            state.replace(key=key),
            physics=physics,
            obs=self.observe(physics),
            reward=reward,
            metrics=metrics,
            episode_length=self.max_steps,
            terminated=self.terminated(physics),
            status=rigid.check_status(bodies, self.model),
        )

    @property
    def up(self) -> np.ndarray:
        """Unit vector against gravity, for pictures, shape (3,); z without gravity."""
        gravity = np.asarray(self.model.gravity, float)
        strength = np.linalg.norm(gravity)
        return -gravity / strength if strength > 0.0 else np.array([0.0, 0.0, 1.0])

    def render_shapes(self, physics: RigidPhysics) -> list[dict[str, Any]]:
        """Drawings of the geoms, see ``rewax.viz.shapes``."""
        return rigid.shapes(self.model, physics.rigid)


def load_asset(name: str, *, dt: float, **kwargs: Any) -> RigidModel:
    """A model of ``assets/`` with another substep [s]; keyword arguments are those of ``rigid.load``."""
    return rigid.load(ASSETS / name, dt=dt, **kwargs)


def uniform(key: Key, size: int, bound: float) -> Array:
    """Numbers between -bound and bound, shape (size,)."""
    return jax.random.uniform(key, (size,), minval=-bound, maxval=bound)


def random_turn(key: Key, bound: float) -> Array:
    """Unit quaternion (w, x, y, z) of a turn by an angle within [-bound, bound] about a random axis.

    The axis is a point of the cube [-0.5, 0.5]^3, normalised, as in DiffRL.
    """
    angle_key, axis_key = jax.random.split(key)
    half = 0.5 * jax.random.uniform(angle_key, (), minval=-bound, maxval=bound)
    axis = jax.random.uniform(axis_key, (3,), minval=-0.5, maxval=0.5)
    axis = axis / jnp.linalg.norm(axis)
    return jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis])


def xyzw(quaternion: Array) -> Array:
    """MuJoCo's (w, x, y, z) in the order of the reference's observations."""
    return quaternion[np.array([1, 2, 3, 0])]
