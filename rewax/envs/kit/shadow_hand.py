"""A Shadow hand with prescribed joint motion, for tasks in which it handles soft bodies."""

from typing import Any

import mujoco
import numpy as np

from rewax import struct
from rewax.envs.kit.rigid_task import ASSETS
from rewax.envs.kit.soft_task import SoftTask
from rewax.physics import rigid
from rewax.physics.contact import Collider
from rewax.physics.numerics import Pose
from rewax.physics.rigid import RigidModel
from rewax.types import Array

NUM_JOINTS = 24


@struct.dataclass
class HandTask(SoftTask):
    """A soft body on a hand. The 24 joints of the hand are WRJ1, WRJ0, FFJ3 to FFJ0, MF, RF, LFJ4 to LFJ0,
    THJ4 to THJ0 [rad].

    Attributes:
      hand: the model of the hand. Its geoms are the colliders of the scene.
    """

    hand: RigidModel

    def poses(self, joint_q: Array) -> Pose:
        return rigid.poses(self.hand, joint_q)

    @property
    def tools(self) -> dict[str, int]:
        return {rigid.body_name(self.hand, body): body for body in sorted({c.body for c in self.scene.colliders})}

    @property
    def camera(self) -> dict[str, Any]:
        return {"azimuth": 60.0, "elevation": 40.0}


def load_hand(*, scale: float, position: tuple[float, float, float]) -> RigidModel:
    """The hand with lengths multiplied by ``scale``, base at ``position`` [m], palm up (y) and fingers along z."""
    spec = mujoco.MjSpec.from_file(str(ASSETS / "shadow_hand.xml"))  # pyright: ignore[reportAttributeAccessIssue]
    for body in spec.bodies:
        body.pos = scale * np.asarray(body.pos)
    for geom in spec.geoms:
        geom.pos, geom.size = scale * np.asarray(geom.pos), scale * np.asarray(geom.size)
    wrist = spec.body("wrist")
    turn = np.array([-1.0, -1.0, 1.0])  # 180 degrees about z, as Rewarped goes from z up to y up
    wrist.pos, wrist.quat = np.asarray(position) + turn * np.asarray(wrist.pos), [0.0, 0.0, 0.0, 1.0]
    return rigid.load(spec, dt=1e-3)


def hand_colliders(hand: RigidModel, *, friction: float, softness: float) -> tuple[Collider, ...]:
    """The 19 geoms of the hand as colliders."""
    return rigid.colliders(hand, friction=friction, softness=softness)


def joint_limits(hand: RigidModel) -> tuple[Array, Array]:
    """Lower and upper limits of the joints [rad], shape (24,) each."""
    limits = hand.parameters["jnt_range"]
    return limits[:, 0], limits[:, 1]
