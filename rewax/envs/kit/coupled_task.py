"""What tasks share in which a robot handles a soft body and feels it: forces go both ways.

A task is a subclass that says what is observed and rewarded; see ``rewax/envs/tasks/gripper_lift.py``.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.appearance import soft_appearance, soft_values
from rewax.envs.kit.checks import checked_observation, checked_start
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.rigid_task import control_in_range
from rewax.envs.kit.soft_task import Scene, Soft, check_list_every, soft_at_rest, soft_status
from rewax.envs.kit.start_noise import ResetNoise, no_noise
from rewax.envs.kit.task import Task, against
from rewax.physics import rigid
from rewax.physics.coupling import Wrench, articulated, no_wrench
from rewax.physics.rigid import RigidModel, RigidState
from rewax.types import Array, Key, Observation, PyTree, Vector


@struct.dataclass
class CoupledPhysics(struct.Replaceable):
    """What a task on a robot and a soft body simulates.

    Attributes:
      rigid: positions and velocities of the robot.
      soft: the particles, or the vertices.
      touch: mean force and torque of the soft body on each body of the robot in the last control step.
      action: the last one, within [-1, 1]; zero after a reset, shape (num_actions,).
      task: what else the task keeps (a goal, say), or None.
    """

    rigid: RigidState
    soft: Soft
    touch: Wrench
    action: Vector
    task: PyTree = None


@struct.dataclass
class CoupledTask(Task):
    """A robot and particles or tetrahedra. Subclasses define ``observe`` and ``reward``, and what else differs.

    Every array is a leaf: differentiate with respect to it or vmap over it.

    Attributes:
      model: the robot; the scene's colliders belong to its bodies (``rigid.colliders``).
      scene: the soft body and what bounds it; its dt divides the model's.
      rest_positions: points before the noise of a reset [m], shape (num_points, 3).
      noise: of a reset.
      cloud: what a policy sees of the points.
      num_substeps: of the robot per control step (static).
      max_steps: control steps per episode (static).
      list_every: particles only: substeps of the robot for which one list of active nodes serves, a divisor of
        num_substeps; None: a whole control step (static).
    """

    model: RigidModel
    scene: Scene
    rest_positions: Vector
    noise: ResetNoise = struct.field(default_factory=no_noise)
    cloud: PointCloud
    num_substeps: int = struct.static_field()
    max_steps: int = struct.static_field()
    list_every: int | None = struct.static_field(default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_list_every(self.list_every, self.num_substeps)
        articulated.soft_substeps(self.scene, self.model)

    # --- What a task defines, beside observe and reward ---

    def start(self, positions: Array, key: Key) -> tuple[RigidState, Soft, PyTree]:
        """Robot and soft body at the beginning of an episode, and what else the task keeps (None for nothing).

        Args:
          positions: ``rest_positions`` with the noise of a reset [m].
          key: for other draws.
        """
        del key
        return rigid.initial_state(self.model), soft_at_rest(self.scene, positions), None

    def control(self, action: Array) -> Array:
        """Controls of the model's actuators for an action within [-1, 1]: from end to end of limited ones' range."""
        return control_in_range(self.model, action)

    # --- The environment ---

    @property
    def num_actions(self) -> int:
        return self.model.num_actuators

    @property
    def control_dt(self) -> float:
        """Duration of a control step [s]."""
        return self.num_substeps * self.model.dt

    def begin(self, key: Key) -> tuple[CoupledPhysics, Key]:
        key, shift_key, stretch_key, start_key = jax.random.split(key, 4)
        positions = self.noise.apply(self.rest_positions, shift_key, stretch_key)
        parts = ("the robot", "the soft body", "what the task keeps")
        bodies, soft, task = checked_start(self, self.start(positions, start_key), parts)
        action, touch = jnp.zeros(self.num_actions, soft.x.dtype), no_wrench(self.model.num_bodies, soft.x)
        return CoupledPhysics(rigid=bodies, soft=soft, touch=touch, action=action, task=task), key

    def advance(self, physics: CoupledPhysics, action: Array) -> tuple[CoupledPhysics, Array]:
        control, every = self.control(action), self.list_every or self.num_substeps

        def move(carry: tuple[Soft, RigidState], _: None) -> tuple[tuple[Soft, RigidState], tuple[Wrench, Array]]:
            before, bodies = carry
            soft, bodies, touch = articulated.step(self.scene, self.model, before, bodies, control, num_substeps=every)  # pyright: ignore[reportArgumentType]
            return (soft, bodies), (touch, soft_status(self.scene, soft, start=before))

        start = (physics.soft, physics.rigid)
        (soft, bodies), (touch, status) = jax.lax.scan(move, start, None, length=self.num_substeps // every)
        status = jax.lax.reduce(status, np.int32(0), jax.lax.bitwise_or, (0,)) | rigid.check_status(bodies, self.model)
        touch = jax.tree.map(lambda a: a.mean(0), touch)
        return physics.replace(rigid=bodies, soft=soft, touch=touch, action=action), status

    def seen(self, physics: CoupledPhysics, key: Key) -> tuple[Observation, Key]:
        return self.cloud.shown(checked_observation(self, self.observe(physics)), (physics.soft.x, physics.soft.v), key)

    def observed(self, physics: CoupledPhysics) -> Array:
        """The fixed points of the cloud, shape (num_points, 3)."""
        return self.cloud.pick(physics.soft.x)

    def particles(self, physics: CoupledPhysics) -> Array:
        """Positions for pictures [m], shape (num_points, 3)."""
        return physics.soft.x

    def particle_values(self, physics: CoupledPhysics) -> dict[str, Array]:
        """Numbers that colour the points in pictures, shape (num_points,) each: ``speed`` [m/s], ``strain`` [-]."""
        return soft_values(physics.soft)

    @property
    def appearance(self) -> dict[str, Any]:
        """How pictures show the soft body, its floor and the camera; see ``rewax.viz.recording``."""
        return {**soft_appearance(self.scene, self.up), "camera": self.camera}

    def render_shapes(self, physics: CoupledPhysics) -> list[dict[str, Any]]:
        """Drawings of the robot, see ``rewax.viz.shapes``."""
        return rigid.shapes(self.model, physics.rigid)

    @property
    def up(self) -> np.ndarray:
        """Unit vector against gravity, for pictures, shape (3,); y without gravity."""
        return against(self.scene.gravity, (0.0, 1.0, 0.0))
