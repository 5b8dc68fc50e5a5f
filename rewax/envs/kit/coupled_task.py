"""Base of tasks in which a robot handles a soft body, with forces on both (two-way coupling).

A subclass defines observation and reward; see ``rewax/envs/tasks/gripper_lift.py``.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.checks import checked_control, checked_start
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.rigid_task import ActuatedTask
from rewax.envs.kit.soft_body import Scene, Soft, SoftBodyTask, check_list_every, soft_at_rest, soft_status
from rewax.envs.kit.start_noise import ResetNoise, no_noise
from rewax.envs.kit.touching import untouched
from rewax.envs.kit.worlds import soft_world
from rewax.physics import rigid
from rewax.physics.contact import WALLS, Patches
from rewax.physics.coupling import Wrench, articulated, no_wrench
from rewax.physics.coupling.mixed import MixedScene
from rewax.physics.rigid import RigidModel, RigidState
from rewax.physics.thin import ThinScene
from rewax.sensors.robots import with_robot
from rewax.sensors.world import World
from rewax.types import Array, Key, PyTree, Vector


@struct.dataclass
class CoupledPhysics(struct.Replaceable):
    """State of a simulation of a robot and a soft body.

    Attributes:
      rigid: positions and velocities of the robot.
      soft: the particles, or the vertices.
      touch: mean force and torque of the soft body on each body of the robot in the last control step.
      action: the last action, within [-1, 1]; zero after a reset, shape (num_actions,).
      task: further state of the task, a goal for example, or None.
      felt: mean force and torque of the last control step on the task's ``touch``, by name; None without it.
    """

    rigid: RigidState
    soft: Soft
    touch: Wrench
    action: Vector
    task: PyTree = None
    felt: dict[str, Wrench] | None = None


@struct.dataclass
class CoupledTask(ActuatedTask, SoftBodyTask):
    """A robot and particles or tetrahedra. Subclasses define ``observe`` and ``reward``; other methods have defaults.

    Every array is a parameter: differentiate with respect to it or vmap over it.

    Attributes:
      model: the robot. The colliders of the scene belong to its bodies (``rigid.colliders``). They are copies of its
        geoms: a change of sizes, places or friction belongs into both.
      scene: the soft body, walls and ground. Its dt divides that of the model.
      rest_positions: points before the noise of a reset [m], shape (num_points, 3).
      noise: random shift and stretch of the points at a reset.
      cloud: the observed points.
      num_substeps: substeps of the robot per control step (static).
      max_steps: control steps per episode (static).
      list_every: for particles, the substeps of the robot for which one list of active nodes serves, a divisor of
        num_substeps; None: a whole control step (static).
      touch: patches of bodies that feel contact, by the name of a sensor; None: nothing is felt. ``Sensing`` sets it.
    """

    model: RigidModel
    scene: Scene
    rest_positions: Vector
    noise: ResetNoise = struct.field(default_factory=no_noise)
    cloud: PointCloud
    num_substeps: int = struct.static_field()
    max_steps: int = struct.static_field()
    list_every: int | None = struct.static_field(default=None)
    touch: dict[str, Patches] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.scene, ThinScene | MixedScene):
            raise ValueError(
                f"scene is a {type(self.scene).__name__}, but the soft body of a CoupledTask has particles or "
                "tetrahedra: for cloth and ropes give a ThinTask with prescribed tools, or call articulated.step in an "
                "environment of your own"
            )
        super().__post_init__()
        check_list_every(self.list_every, self.num_substeps)
        articulated.soft_substeps(self.scene, self.model)

    # --- Methods that a task defines, beside observe and reward ---

    def start(self, positions: Array, key: Key) -> tuple[RigidState, Soft, PyTree]:
        """Robot and soft body at the beginning of an episode, and ``physics.task``: further state, or None.

        Args:
          positions: ``rest_positions`` with the noise of a reset [m].
          key: for further draws.
        """
        del key
        return rigid.initial_state(self.model), soft_at_rest(self.scene, positions), None

    # --- The environment ---

    def begin(self, key: Key) -> tuple[CoupledPhysics, Key]:
        key, shift_key, stretch_key, start_key = jax.random.split(key, 4)
        positions = self.noise.apply(self.rest_positions, shift_key, stretch_key)
        parts = {"the robot": RigidState, "the soft body": self.soft_kind}
        bodies, soft, task = checked_start(self, self.start(positions, start_key), parts)
        action, touch = jnp.zeros(self.num_actions, soft.x.dtype), no_wrench(self.model.num_bodies, soft.x)
        felt = untouched(self.touch, soft.x)
        return CoupledPhysics(rigid=bodies, soft=soft, touch=touch, action=action, task=task, felt=felt), key

    def advance(self, physics: CoupledPhysics, action: Array) -> tuple[CoupledPhysics, Array]:
        control, every = checked_control(self, self.control(action)), self.list_every or self.num_substeps

        def move(carry: tuple[Soft, RigidState], _: None) -> tuple[tuple[Soft, RigidState], tuple[Any, Array]]:
            before, bodies = carry
            bodily = (self.scene, self.model, before, bodies, control)
            if self.touch is None:
                soft, bodies, touch = articulated.step(*bodily, num_substeps=every)  # pyright: ignore[reportArgumentType]
                felt = None
            else:
                soft, bodies, touch, felt = articulated.step_with_touch(*bodily, patches=self.touch, num_substeps=every)  # pyright: ignore[reportArgumentType]
            status = soft_status(self.scene, soft, start=before) | rigid.check_status(bodies)
            return (soft, bodies), ((touch, felt), status)

        start = (physics.soft, physics.rigid)
        (soft, bodies), (mean, status) = jax.lax.scan(move, start, None, length=self.num_substeps // every)
        status = jax.lax.reduce(status, np.int32(0), jax.lax.bitwise_or, (0,)) | rigid.check_status(bodies, self.model)
        touch, felt = jax.tree.map(lambda a: a.mean(0), mean)
        return physics.replace(rigid=bodies, soft=soft, touch=touch, action=action, felt=felt), status

    @property
    def feeling_bodies(self) -> dict[str, int]:
        found = rigid.touching_bodies(self.model)
        own = {collider.body for collider in self.scene.colliders}
        names = {rigid.body_name(self.model, body): body for body in sorted({*found.values(), *own})}
        if "walls" in names:
            raise ValueError("the robot has a body named 'walls', as touch calls the scene's walls: rename the body")
        return {**names, "walls": WALLS}

    def render_shapes(self, physics: CoupledPhysics) -> list[dict[str, Any]]:
        """Drawings of the robot, see ``rewax.viz.shapes``."""
        return rigid.shapes(self.model, physics.rigid)

    def world(self, physics: CoupledPhysics, up: np.ndarray) -> World:
        """The world that sensors observe: the robot by names of bodies, the soft body, the floor; see ``SoftTask``."""
        return with_robot(soft_world(self.scene, physics.soft, up), self.model, physics.rigid)
