"""Base of tasks on articulated rigid bodies: reset, control step, time limit, pictures.

A subclass defines the start of an episode, observation, reward and termination; see ``examples/custom_rigid_task.py``.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.checks import checked_control, checked_start
from rewax.envs.kit.task import Task, against
from rewax.envs.kit.touching import untouched
from rewax.physics import rigid
from rewax.physics.contact import Patches, Wrench
from rewax.physics.rigid import RigidModel, RigidState
from rewax.sensors.robots import with_robot
from rewax.sensors.world import World
from rewax.types import Array, Key, PyTree, Vector

ASSETS = Path(__file__).parent.parent / "assets"
"""Folder of the MJCF models of the tasks in rewax."""


@struct.dataclass
class RigidPhysics(struct.Replaceable):
    """State of a simulation of rigid bodies.

    Attributes:
      rigid: positions and velocities of the bodies.
      action: the last action, within [-1, 1]; zero after a reset, shape (num_actions,).
      task: further state of the task, a goal for example, or None.
      felt: mean force and torque of the last control step on the task's ``touch``, by name; None without it.
    """

    rigid: RigidState
    action: Vector
    task: PyTree = None
    felt: dict[str, Wrench] | None = None


class ActuatedTask(Task):
    """Base of ``RigidTask`` and ``CoupledTask``: an action drives the actuators of a model."""

    model: RigidModel

    def control(self, action: Array) -> Array:
        """Controls of the actuators for an action within [-1, 1], which spans the range of each limited actuator."""
        return control_in_range(self.model, action)

    @property
    def num_actions(self) -> int:
        return self.model.num_actuators

    @property
    def feeling_bodies(self) -> dict[str, int]:
        return rigid.touching_bodies(self.model)

    @property
    def control_dt(self) -> float:
        """Duration of a control step [s]."""
        return self.num_substeps * self.model.dt


@struct.dataclass
class RigidTask(ActuatedTask):
    """A task on one model. Subclasses define ``start``, ``observe`` and ``reward``; other methods have defaults.

    Attributes:
      model: bodies, actuators and contact law. Its numbers are parameters: differentiate with respect to them, or vmap
        over them.
      num_substeps: substeps per control step (static).
      max_steps: control steps per episode (static).
      touch: patches of bodies that feel contact, by the name of a sensor; None: nothing is felt. ``Sensing`` sets it.
    """

    model: RigidModel
    num_substeps: int = struct.static_field()
    max_steps: int = struct.static_field()
    touch: dict[str, Patches] | None = None

    # --- Methods that a task defines ---

    def start(self, key: Key) -> tuple[RigidState, PyTree]:
        """Bodies at the beginning of an episode, and ``physics.task``: further state of the task, or None."""
        raise NotImplementedError(f"{type(self).__name__} has no start(key): define it")

    # --- The environment ---

    def begin(self, key: Key) -> tuple[RigidPhysics, Key]:
        key, start_key = jax.random.split(key)
        bodies, task = checked_start(self, self.start(start_key), {"the bodies": RigidState})
        action = jnp.zeros(self.action_spec.shape, bodies.qpos.dtype)
        felt = untouched(self.touch, bodies.qpos)
        return RigidPhysics(rigid=bodies, action=action, task=task, felt=felt), key

    def advance(self, physics: RigidPhysics, action: Array) -> tuple[RigidPhysics, Array]:
        control, felt = checked_control(self, self.control(action)), None
        options = {"ctrl": control, "num_substeps": self.num_substeps}
        if self.touch is None:
            bodies = rigid.step(self.model, physics.rigid, **options)
        else:
            bodies, felt = rigid.step_with_touch(self.model, physics.rigid, patches=self.touch, **options)
        return physics.replace(rigid=bodies, action=action, felt=felt), rigid.check_status(bodies, self.model)

    def world(self, physics: RigidPhysics, up: np.ndarray) -> World:
        """The world that sensors observe: the geoms by the names of their bodies."""
        del up
        return with_robot(World(), self.model, physics.rigid)

    @property
    def up(self) -> np.ndarray:
        """Unit vector opposite to gravity, for pictures, shape (3,); z if gravity is zero."""
        return against(self.model.gravity, (0.0, 0.0, 1.0))

    @property
    def appearance(self) -> dict[str, Any]:
        """The camera of pictures; see ``rewax.viz.recording``."""
        return {"camera": self.camera}

    def render_shapes(self, physics: RigidPhysics) -> list[dict[str, Any]]:
        """Drawings of the geoms, see ``rewax.viz.shapes``."""
        return rigid.shapes(self.model, physics.rigid)


def control_in_range(model: RigidModel, action: Array) -> Array:
    """Controls for an action within [-1, 1]: it spans the range of a limited actuator, and is the control of others."""
    limited = model.static.mj.actuator_ctrllimited.astype(bool)
    low, high = jnp.moveaxis(model.parameters["actuator_ctrlrange"], -1, 0)
    return jnp.where(limited, 0.5 * (low + high) + 0.5 * (high - low) * action, action)


def load_asset(name: str, *, dt: float, **kwargs: Any) -> RigidModel:
    """The model of a file in ``assets/`` with substep ``dt`` [s]; other arguments are those of ``rigid.load``."""
    return rigid.load(ASSETS / name, dt=dt, **kwargs)


def uniform(key: Key, size: int, bound: float) -> Array:
    """Uniform random numbers within [-bound, bound], shape (size,)."""
    return jax.random.uniform(key, (size,), minval=-bound, maxval=bound)


def random_turn(key: Key, bound: float) -> Array:
    """Unit quaternion (w, x, y, z) of a rotation by a random angle within [-bound, bound] about a random axis.

    The axis is a uniform point of the cube [-0.5, 0.5]^3, normalised, as in DiffRL.
    """
    angle_key, axis_key = jax.random.split(key)
    half = 0.5 * jax.random.uniform(angle_key, (), minval=-bound, maxval=bound)
    axis = jax.random.uniform(axis_key, (3,), minval=-0.5, maxval=0.5)
    axis = axis / jnp.linalg.norm(axis)
    return jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis])


def xyzw(quaternion: Array) -> Array:
    """A quaternion (w, x, y, z), as MuJoCo orders it, in the order of Rewarped's observations."""
    return quaternion[np.array([1, 2, 3, 0])]
