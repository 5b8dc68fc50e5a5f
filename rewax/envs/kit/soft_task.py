"""Base of tasks on particles or tetrahedra: reset, moving tools, control step, time limit, pictures.

A subclass defines observation and reward; see ``examples/custom_soft_task.py``. Tools are colliders of the scene. Their
joints move linearly within a control step and stop at their limits.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rewax import struct
from rewax.envs.kit.checks import checked_poses, checked_start
from rewax.envs.kit.options import flag_option, integer_option
from rewax.envs.kit.point_cloud import PointCloud
from rewax.envs.kit.soft_body import Scene, Soft, SoftBodyTask, check_list_every, soft_at_rest, soft_status
from rewax.envs.kit.start_noise import ResetNoise, no_noise
from rewax.envs.kit.touching import felt_step, named_tools, untouched
from rewax.envs.kit.worlds import soft_world, with_tools
from rewax.physics import mpm, tets
from rewax.physics.contact import WALLS, Patches, Wrench, drawings
from rewax.physics.mpm import MPMState
from rewax.physics.numerics import Pose
from rewax.physics.numerics.arguments import real_array
from rewax.physics.numerics.clipping import clipped
from rewax.physics.tets import TetScene, TetState
from rewax.sensors.world import World
from rewax.types import Array, Key, Observation, PyTree, Vector


@struct.dataclass
class SoftPhysics(struct.Replaceable):
    """State of a simulation of soft bodies and tools.

    Attributes:
      soft: the particles, or the vertices.
      joint_q: positions of the tools' joints [m, rad], shape (num_joints,).
      joint_qd: motion of the joints in the last control step, in units of ``joint_step``, shape (num_joints,).
      action: the last action, within [-1, 1]; zero after a reset, shape (num_actions,).
      task: further state of the task, a goal for example, or None.
      felt: mean force and torque of the last control step on the task's ``touch``, by name; None without it.
    """

    soft: Soft
    joint_q: Vector
    joint_qd: Vector
    action: Vector
    task: PyTree = None
    felt: dict[str, Wrench] | None = None


@struct.dataclass
class SoftTask(SoftBodyTask):
    """A task on one scene. Subclasses define ``reward``, and ``poses`` if there are tools; other methods have defaults.

    Every array is a parameter: differentiate with respect to it or vmap over it.

    Attributes:
      scene: the soft bodies, the tools as its colliders, walls and ground.
      rest_positions: points before the noise of a reset [m], shape (num_points, 3).
      noise: random shift and stretch of the points at a reset.
      joint_start, joint_lower, joint_upper: first joint_q and its limits [m, rad], shape (num_joints,). The start may
        lie beyond a limit by joint_step at most: the first step then moves the joint to the limit.
      joint_step: change of joint_q per control step for action 1 [m, rad], shape (num_joints,).
      cloud: the observed points.
      num_substeps: substeps per control step (static).
      max_steps: control steps per episode (static).
      exact_limits: whether a joint that a limit stops has derivative 0 with respect to its previous position, which is
        exact. If False, limits are frozen, as in Rewarped: that derivative is 1, and gradients of earlier actions
        are wrong (static).
      list_every: for particles, the substeps for which one list of active nodes serves, a divisor of num_substeps;
        None: a whole control step (static).
      store_every: substeps between stored states in the backward pass, see ``mpm.step`` (static).
      touch: patches of tools that feel contact, by the name of a sensor; None: nothing is felt. ``Sensing`` sets it.
    """

    scene: Scene
    rest_positions: Vector
    noise: ResetNoise = struct.field(default_factory=no_noise)
    joint_start: Vector = struct.field(default_factory=lambda: jnp.zeros(0))
    joint_lower: Vector = struct.field(default_factory=lambda: jnp.zeros(0))
    joint_upper: Vector = struct.field(default_factory=lambda: jnp.zeros(0))
    joint_step: Vector = struct.field(default_factory=lambda: jnp.zeros(0))
    cloud: PointCloud
    num_substeps: int = struct.static_field()
    max_steps: int = struct.static_field()
    exact_limits: bool = struct.static_field(default=True)
    list_every: int | None = struct.static_field(default=None)
    store_every: int = struct.static_field(default=1)
    touch: dict[str, Patches] | None = None
    limits_joints: ClassVar[bool] = True
    """Whether the limits are those of the joints themselves, and not of set points that the joints follow."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_list_every(self.list_every, self.num_substeps)
        if self.list_every is not None and isinstance(self.scene, TetScene):
            raise ValueError(
                f"list_every is {self.list_every}, but tetrahedra have no list of active nodes: leave it out"
            )
        integer_option("store_every", self.store_every, "give a divisor of num_substeps, 1 to store every state")
        flag_option("exact_limits", self.exact_limits)
        wanted = _shape_of_joints("joint_start", self.joint_start)
        for name in ("joint_lower", "joint_upper", "joint_step"):
            if (shape := _shape_of_joints(name, getattr(self, name))) != wanted:
                raise ValueError(f"{name} has shape {shape}, but joint_start {wanted}: give one number for each joint")
        self._check_joints()

    def _check_joints(self) -> None:
        """Raises ValueError for concrete joints without a range, that move against their action, or start outside."""
        joints = (self.joint_lower, self.joint_upper, self.joint_step)
        if any(isinstance(numbers, Tracer) for numbers in joints):
            return
        lower, upper, step = map(np.asarray, joints)
        if not np.all(lower <= upper):
            raise ValueError(f"joint_lower is {lower} and joint_upper {upper}: give a lower limit below the upper one")
        if not (np.all(step >= 0) and np.all(np.isfinite(step))):
            raise ValueError(f"joint_step is {step}: give the change per control step for action 1, 0 or more")
        if not self.limits_joints or isinstance(self.joint_start, Tracer):
            return
        start = np.asarray(self.joint_start)
        beyond = np.maximum(lower - start, start - upper)
        if not np.all(beyond <= step + 1e-5 * (1.0 + np.abs(start))):
            raise ValueError(
                f"joint_start is {start}, outside of the limits {lower} to {upper}, to which the first step would make "
                "the tools jump: give a start within the limits"
            )

    # --- Methods that a task defines ---

    def poses(self, joint_q: Array) -> Pose:
        """Poses of the bodies that the colliders belong to, shape (n, num_bodies, ...), for joint_q (n, num_joints)."""
        if self.scene.colliders:
            raise NotImplementedError(f"{type(self).__name__} has colliders but no poses(joint_q): define it")
        return tets.static_poses(len(joint_q) - 1, dtype=joint_q.dtype)

    def observe(self, physics: SoftPhysics) -> Observation:
        """Named observations of a state; by default the observed points, their mean, and the joints of the tools."""
        seen = self.observed(physics)
        obs = {"particle_q": seen, "com_q": seen.mean(0)}
        return {**obs, "joint_q": physics.joint_q} if self.num_joints else obs

    def start(self, positions: Array, key: Key) -> tuple[Soft, PyTree]:
        """Soft bodies at the beginning of an episode, and ``physics.task``: further state of the task, or None.

        Args:
          positions: ``rest_positions`` with the noise of a reset [m].
          key: for further draws.
        """
        del key
        return self.at_rest(positions), None

    def actuated(self, action: Array) -> Scene:
        """The scene of a control step. Components of the action beyond the joints' may change it (muscles)."""
        del action
        return self.scene

    @property
    def num_actions(self) -> int:
        """Number of components of an action. The first ones move the joints; ``actuated`` uses others."""
        return self.num_joints

    # --- The environment ---

    @property
    def num_joints(self) -> int:
        return self.joint_start.shape[-1]

    @property
    def control_dt(self) -> float:
        """Duration of a control step [s]."""
        return self.num_substeps * self.scene.dt

    def begin(self, key: Key) -> tuple[SoftPhysics, Key]:
        key, shift_key, stretch_key, start_key = jax.random.split(key, 4)
        positions = self.noise.apply(self.rest_positions, shift_key, stretch_key)
        soft, task = checked_start(self, self.start(positions, start_key), {"the soft bodies": self.soft_kind})
        physics = SoftPhysics(
            soft=soft,
            joint_q=self.joint_start,
            joint_qd=jnp.zeros_like(self.joint_start),
            action=jnp.zeros(self.num_actions, soft.x.dtype),
            task=task,
            felt=untouched(self.touch, soft.x),
        )
        return physics, key

    def advance(self, physics: SoftPhysics, action: Array) -> tuple[SoftPhysics, Array]:
        """Moves joints by ``joint_step * action``, clipped to their limits, and the soft bodies with them.

        Gradient: exact through the soft bodies; ``exact_limits`` says what it is at limits. An action that pushes a
          joint against its limit has gradient zero. Action 0 at the limit has that of an action away from it.
        """
        q = physics.joint_q
        before = q if self.exact_limits else jax.lax.stop_gradient(q)
        motion = action[: self.num_joints] * self.joint_step
        motion = clipped(motion, self.joint_lower - before, self.joint_upper - before)
        fraction = jnp.linspace(0.0, 1.0, self.num_substeps + 1, dtype=q.dtype)
        soft, felt, status = self._driven(physics, action, q + fraction[:, None] * motion)
        rate = motion / jnp.where(self.joint_step > 0.0, self.joint_step, 1.0)  # 0: a joint that stands still
        moved = physics.replace(soft=soft, joint_q=q + motion, joint_qd=rate, action=action, felt=felt)
        return moved, status

    def at_rest(self, positions: Array) -> Soft:
        """The state of undeformed particles, or of vertices, at these positions [m] with velocity zero."""
        return soft_at_rest(self.scene, positions)

    def render_shapes(self, physics: SoftPhysics) -> list[dict[str, Any]]:
        """Drawings of the tools, see ``rewax.viz.shapes``."""
        return drawings(self.scene.colliders, jax.tree.map(lambda a: a[0], self.poses(physics.joint_q[None])))

    def world(self, physics: SoftPhysics, up: np.ndarray) -> World:
        """The world that sensors observe: soft bodies, tools (``tool``) and the floor; bodies are those of the tools.

        Args:
          physics: of a state.
          up: unit vector against gravity, shape (3,): a part of the program, as ``self.up`` is not where the
            environment is an argument of it.
        """
        bodies = jax.tree.map(lambda a: a[0], self.poses(physics.joint_q[None]))
        return with_tools(soft_world(self.scene, physics.soft, up), self.scene.colliders, bodies)

    @property
    def feeling_bodies(self) -> dict[str, int]:
        return {**self.tools, "walls": WALLS}

    @property
    def tools(self) -> dict[str, int]:
        """The bodies of the colliders by name: ``tool``, or ``tool_0``, ``tool_1``, ... of several."""
        return named_tools(self.scene.colliders)

    def _driven(self, physics: SoftPhysics, action: Array, path: Array) -> tuple[Soft, Any, Array]:
        """Result of ``_move`` for joints at the boundaries of the substeps, shape (n, num_joints)."""
        poses = checked_poses(self, self.poses(path), len(path))
        return self._move(self.actuated(action), physics.soft, poses)

    def _move(self, scene: Scene, soft: Soft, poses: Pose) -> tuple[Soft, Any, Array]:
        """Soft bodies after the substeps between poses, what the tools felt, and status bits.

        Each ``list_every`` substeps have their own list of active nodes, because fast particles leave the nodes of an
        older list. The status checks every list.
        """
        if isinstance(scene, TetScene):
            assert isinstance(soft, TetState)
            vertices, felt = felt_step(tets, scene, soft, poses, self.touch, self.store_every)
            return vertices, felt, soft_status(scene, vertices, start=soft, poses=poses)

        def move(particles: MPMState, poses: Pose) -> tuple[MPMState, tuple[Any, Array]]:
            end, felt = felt_step(mpm, scene, particles, poses, self.touch, self.store_every)
            return end, (felt, soft_status(scene, end, start=particles, poses=poses))

        assert isinstance(soft, MPMState)
        every = self.list_every or self.num_substeps
        if every == self.num_substeps:
            particles, (felt, status) = move(soft, poses)
            return particles, felt, status
        boundaries = np.arange(0, self.num_substeps, every)[:, None] + np.arange(every + 1)
        particles, (felt, status) = jax.lax.scan(move, soft, jax.tree.map(lambda a: a[boundaries], poses))
        felt = jax.tree.map(lambda a: a.mean(0), felt)
        return particles, felt, jax.lax.reduce(status, np.int32(0), jax.lax.bitwise_or, (0,))


def _shape_of_joints(name: str, value: Any) -> tuple[int, ...]:
    remedy = "give one number for each joint"
    shape = real_array(name, value, remedy).shape
    if not shape:
        raise ValueError(f"{name} is one number: {remedy}, a tuple of one for one joint")
    return shape
