"""Hands that follow set points without jumps of their velocity, which would shake what they hold."""

from typing import Any, ClassVar

import jax.numpy as jnp

from rewax import struct
from rewax.envs.kit.soft_task import SoftPhysics
from rewax.envs.kit.thin_task import ThinTask
from rewax.physics.numerics.clipping import clipped
from rewax.types import Array, Key, PyTree, Scalar


@struct.dataclass
class Following(ThinTask):
    """A task whose joints follow set points as critically damped oscillators. Subclasses say where those are.

    ``joint_qd`` holds the velocities of the joints [m/s, rad/s]. ``exact_limits`` must be true: joints have no limits
    of their own that could be frozen.

    Attributes:
      rate: angular frequency of the joints [rad/s].
    """

    rate: Scalar
    limits_joints: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.exact_limits:
            raise ValueError("exact_limits is False, but joints that follow set points have no limits: leave it out")

    def set_point(self, physics: SoftPhysics, action: Array) -> Array:
        """Where the joints go to in a control step, shape (num_joints,)."""
        raise NotImplementedError(f"{type(self).__name__} has no set_point(physics, action): define it")

    def advance(self, physics: SoftPhysics, action: Array) -> tuple[SoftPhysics, Array]:
        """Joints move as p* + (e + (v + rate e) t) exp(-rate t): p* the set point, e their offset, v their velocity.

        Gradient: exact.
        """
        aim = self.set_point(physics, action)
        time = jnp.linspace(0.0, self.control_dt, self.num_substeps + 1, dtype=action.dtype)[:, None]
        away, speed = physics.joint_q - aim, physics.joint_qd
        approach = speed + self.rate * away
        path = aim + (away + approach * time) * jnp.exp(-self.rate * time)
        soft, felt, status = self._driven(physics, action, path)
        last = (speed - self.rate * approach * self.control_dt) * jnp.exp(-self.rate * self.control_dt)
        moved = physics.replace(soft=soft, joint_q=path[-1], joint_qd=last, action=action, felt=felt)
        return moved, status


@struct.dataclass
class Steered(Following):
    """A task whose actions move the set points by ``joint_step * action``, up to the limits of the joints.

    ``physics.task`` holds the set points. They stay where they are for action zero. Observations need ``ahead``: it is
    part of the state.
    """

    def begin(self, key: Key) -> tuple[Any, Key]:
        physics, key = super().begin(key)
        return physics.replace(task=clipped(physics.joint_q, self.joint_lower, self.joint_upper)), key

    def set_point(self, physics: SoftPhysics, action: Array) -> Array:
        """Gradient: exact; zero where a limit stops a set point, at the limit itself that of the inside."""
        return clipped(physics.task + action * self.joint_step, self.joint_lower, self.joint_upper)

    def ahead(self, physics: SoftPhysics) -> Array:
        """The set points relative to the joints, shape (num_joints,)."""
        return physics.task - physics.joint_q

    def next_task(self, physics: SoftPhysics, key: Key) -> PyTree:
        del key
        return self.set_point(physics, physics.action)


__all__ = ["Following", "Steered"]
