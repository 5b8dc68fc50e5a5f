"""HandReorient: an Allegro hand, palm up, catches a cube and turns it to a goal orientation.

The z axis of the world points up. Scale ``paper`` has the hand, cube, goal and control step of Rewarped. Scale
``small`` has longer substeps and shorter episodes.
"""

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.envs.kit.options import Substeps, substeps
from rewax.envs.kit.rigid_task import RigidPhysics, RigidTask, load_asset, uniform, xyzw
from rewax.physics import rigid
from rewax.physics.numerics import quaternion_product, quaternion_to_matrix
from rewax.physics.rigid import Penalty, RigidState
from rewax.types import Array, Key, Observation, PyTree, Vector

REFERENCE_CONTACT = Penalty(
    stiffness=500.0,
    damping=100.0,
    friction_damping=100.0,
    limit_stiffness=100.0,
    limit_damping=10.0,
    at_surfaces=True,
    boxes_touch_once=True,
)
"""Contacts and joint limits as in Rewarped, where two boxes touch at up to 24 points. Here they touch at one."""

_NUM_JOINTS = 16
_WIDTH = 1e-3
"""Width of the two sigmoids in the bonus, which replace steps: of an angle [rad] and of the first sigmoid [-]."""
_MAX_SINE = 1.0 - 1e-3
"""Upper bound of the sine of half the angle to the goal: at 1 the arc sine has an infinite derivative."""


@struct.dataclass
class HandReorient(RigidTask):
    """The task; ``rewax.make("HandReorient", scale=...)`` builds it.

    Observation ``state``, 72 numbers: joint angles, -1 and 1 at their limits (16), 0.2 joint rates (16), the cube's
    position (3), orientation x, y, z, w (4), velocity (3) and 0.2 angular velocity (3), the goal's position (3) and
    orientation (4), the rotation from the goal to the cube (4), last action (16). Joints and actions are in the order
    thumb, ring, middle and index finger, each from the palm outwards. The joint torques are 2 N m times the action.

    ``physics.task`` is the orientation of the goal (w, x, y, z), shape (4,). A reset draws it, and so does a step in
    which the cube comes within ``tolerance`` of it; the observation after that step shows the new goal.

    Attributes:
      goal_position: desired position of the cube [m], shape (3,).
      tolerance: angle at which a goal is reached [rad].
      fall_distance: distance between cube and goal at which the episode ends [m].
    """

    goal_position: Vector
    tolerance: Vector
    fall_distance: Vector

    def start(self, key: Key) -> tuple[RigidState, PyTree]:
        keys = jax.random.split(key, 4)
        low, high = self._joint_limits()
        joints = 0.2 * jax.random.uniform(keys[0], (_NUM_JOINTS,), minval=low, maxval=high)
        position = self.model.home[_NUM_JOINTS:][:3] + uniform(keys[1], 3, 0.01)
        cube = jnp.concatenate([position, random_goal(keys[2])])
        return rigid.initial_state(self.model, jnp.concatenate([joints, cube])), random_goal(keys[3])

    def observe(self, physics: RigidPhysics) -> Observation:
        q, v, goal = physics.rigid.qpos, physics.rigid.qvel, physics.task
        low, high = self._joint_limits()
        joints = (2.0 * q[:_NUM_JOINTS] - high - low) / (high - low)
        position, orientation = q[_NUM_JOINTS:][:3], q[_NUM_JOINTS:][3:]
        velocity, spin = v[_NUM_JOINTS:][:3], quaternion_to_matrix(orientation) @ v[_NUM_JOINTS:][3:]
        hand = [joints, 0.2 * v[:_NUM_JOINTS]]
        cube = [position, xyzw(orientation), velocity, 0.2 * spin]
        goals = [self.goal_position, xyzw(goal), xyzw(rotation_between(goal, orientation))]
        return {"state": jnp.concatenate([*hand, *cube, *goals, physics.action])}

    def reward(self, physics: RigidPhysics) -> tuple[Array, dict[str, Array]]:
        """-10 distance + 1 / (angle + 0.1) - 0.0002 |action|^2 + bonus, with a bonus of at most 125.

        The bonus is that of Rewarped: 250 sigmoid(-|s - 1| / width), where s = 1 - sigmoid((angle - tolerance) /
        width) is near 1 if the goal is reached. Rewarped has a flag that keeps s at 1 after a goal was reached;
        it is always 0 there, because the goal has changed by the next reward, and so it is left out here.
        """
        distance, angle = self._distance(physics), self._angle(physics)
        reached = 1.0 - jax.nn.sigmoid((angle - self.tolerance) / _WIDTH)
        bonus = 250.0 * jax.nn.sigmoid(-jnp.abs(reached - 1.0) / _WIDTH)
        reward = -10.0 * distance + 1.0 / (angle + 0.1) - 0.0002 * jnp.sum(physics.action**2) + bonus
        return reward, {"distance": distance, "angle": angle, "reached": self._reached(physics).astype(angle.dtype)}

    def terminated(self, physics: RigidPhysics) -> Array:
        return self._distance(physics) >= self.fall_distance

    def next_task(self, physics: RigidPhysics, key: Key) -> PyTree:
        return jnp.where(self._reached(physics), random_goal(key), physics.task)

    def _joint_limits(self) -> tuple[Array, Array]:
        limits = self.model.parameters["jnt_range"][:_NUM_JOINTS]
        return limits[:, 0], limits[:, 1]

    def _distance(self, physics: RigidPhysics) -> Array:
        return _norm(physics.rigid.qpos[_NUM_JOINTS:][:3] - self.goal_position)

    def _angle(self, physics: RigidPhysics) -> Array:
        """Angle between cube and goal [rad], at most 3.05, shape ()."""
        rotation = rotation_between(physics.task, physics.rigid.qpos[_NUM_JOINTS:][3:])
        return 2.0 * jnp.arcsin(jnp.minimum(_norm(rotation[1:]), _MAX_SINE))

    def _reached(self, physics: RigidPhysics) -> Array:
        return self._angle(physics) <= self.tolerance


def random_goal(key: Key) -> Array:
    """Unit quaternion (w, x, y, z) of a random rotation about y, then one about x, by angles within [-pi, pi]."""
    half_x, half_y = 0.5 * uniform(key, 2, np.pi)
    zero = jnp.zeros(())
    about_x = jnp.stack([jnp.cos(half_x), jnp.sin(half_x), zero, zero])
    about_y = jnp.stack([jnp.cos(half_y), zero, jnp.sin(half_y), zero])
    return quaternion_product(about_x, about_y)


def rotation_between(first: Array, second: Array) -> Array:
    """The rotation from one orientation to another, all unit quaternions (w, x, y, z). Gradient: exact."""
    return quaternion_product(second, first * np.array([1.0, -1.0, -1.0, -1.0]))


def _norm(a: Array) -> Array:
    """Euclidean norm; its derivative at zero is zero."""
    square = jnp.sum(a * a)
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def make_hand_reorient(
    *, scale: str, contact: Penalty | None = None, dt: float | None = None, num_substeps: int | None = None
) -> HandReorient:
    """Factory for the registry.

    Args:
      scale: ``"paper"``: 64 substeps per control step of 1/120 s and 600 steps; ``"small"``: 8 and 150.
      contact: contacts and joint limits, ``REFERENCE_CONTACT`` for example; None: those of the scale.
      dt, num_substeps: see ``rewax.make``.
    """
    if contact is not None and not isinstance(contact, Penalty):
        raise ValueError(f"contact is {contact!r}: give a rewax.physics.rigid.Penalty, or None for the scale's own")
    count, max_steps, penalty = _SCALES[scale]
    steps = substeps(dt, num_substeps, Substeps(1.0 / 120 / count, count))
    model = load_asset("allegro.xml", dt=steps.dt, penalty=penalty if contact is None else contact)
    return HandReorient(
        model=model,
        num_substeps=steps.num,
        max_steps=max_steps,
        goal_position=model.home[_NUM_JOINTS:][:3] - jnp.array([0.0, 0.0, 0.04]),
        tolerance=0.1,
        fall_distance=0.24,
    )


_SELF = Penalty(stiffness=2000.0, damping=100.0, friction_damping=100.0, onset=1e-3)
"""Contact of the hand with itself. It is as stiff as about four points of Rewarped: poses stay near its poses."""
_FIRM = Penalty(
    stiffness=8000.0,
    damping=100.0,
    friction_damping=100.0,
    onset=1e-3,
    limit_stiffness=100.0,
    limit_damping=10.0,
    among=_SELF,
    boxes_touch_once=True,
)
_SMALL = _FIRM.replace(
    stiffness=5000.0,
    damping=40.0,
    friction_damping=60.0,
    limit_stiffness=40.0,
    limit_damping=1.2,
    among=_SELF.replace(damping=40.0, friction_damping=60.0),
)
_SCALES = {"paper": (64, 600, _FIRM), "small": (8, 150, _SMALL)}
"""For each scale: substeps per control step, control steps per episode, contact."""
