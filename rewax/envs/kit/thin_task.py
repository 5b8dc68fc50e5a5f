"""Base of tasks on cloth and ropes, whose held vertices and grasps follow the joints."""

from typing import Any, ClassVar

import jax
import numpy as np

from rewax import struct
from rewax.envs.kit.appearance import soft_appearance
from rewax.envs.kit.checks import checked_poses
from rewax.envs.kit.soft_body import Soft
from rewax.envs.kit.soft_task import SoftPhysics, SoftTask
from rewax.envs.kit.worlds import thin_world, with_tools
from rewax.physics import thin
from rewax.physics.contact import Collider
from rewax.physics.numerics import Pose
from rewax.physics.thin import ThinScene, ThinState
from rewax.sensors.world import World
from rewax.types import Array, Key

GRIPPER = (0.25, 0.28, 0.33)
"""Colour of what holds vertices: red, green and blue."""


@struct.dataclass
class ThinTask(SoftTask):
    """A ``SoftTask`` on one ``ThinScene``.

    Subclasses define ``reward``, ``pins`` if vertices are held, and ``poses`` and ``grips`` if bodies grasp.

    Joints move held vertices, bodies with grasps, and colliders.

    Attributes:
      scene: cloth and ropes, tools as its colliders, and the ground.
      thickness: of cloth and ropes in pictures and for cameras [m] (static).
    """

    scene: ThinScene  # pyright: ignore[reportIncompatibleVariableOverride]
    thickness: float = struct.static_field(default=0.01)
    kinds: ClassVar[dict[type, type]] = {ThinScene: ThinState}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.touch is not None:
            raise ValueError("touch is given, but colliders feel no force of cloth and ropes: give touch=None")
        if self.list_every is not None:
            raise ValueError(f"list_every is {self.list_every}, but only tasks of particles alone use it: leave it out")

    # --- Methods that a task defines ---

    def pins(self, physics: SoftPhysics, joint_q: Array) -> Array:
        """Positions of the held vertices [m], shape (n, num_held, 3), for joint_q (n, num_joints).

        ``physics`` is the state at the beginning of the control step.
        """
        del physics, joint_q
        raise NotImplementedError(f"{type(self).__name__} holds vertices but has no pins(physics, joint_q): define it")

    def grips(self, joint_q: Array) -> Array:
        """How far each grasp of the scene is closed, 0 to 1, shape (n, num_grasps), for joint_q (n, num_joints)."""
        del joint_q
        raise NotImplementedError(f"{type(self).__name__} has grasps but no grips(joint_q): define it")

    def first_joints(self, physics: SoftPhysics) -> Array:
        """Positions of the joints at the beginning of an episode, shape (num_joints,)."""
        del physics
        return self.joint_start

    # --- What differs if there are particles, too ---

    @property
    def thin_scene(self) -> ThinScene:
        """The scene of cloth and ropes."""
        return self.scene

    def opened(self, soft: Any, bodies: Pose) -> Any:
        """The soft body at the beginning of an episode, whose grasps are open."""
        return thin.open_grasps(self.scene, soft, bodies)

    def vertices(self, physics: SoftPhysics) -> Array:
        """Positions of the vertices [m], shape (num_vertices, 3)."""
        return physics.soft.x

    def stepped(self, scene: Any, soft: Any, poses: Pose, **driven: Any) -> tuple[Any, Array]:
        """The soft body after the substeps between poses, and its status; ``driven`` are arguments of ``thin.step``."""
        end = thin.step(scene, soft, poses, **driven)
        return end, thin.check_status(scene, end, poses=poses)

    # --- The environment ---

    def begin(self, key: Key) -> tuple[SoftPhysics, Key]:
        physics, key = super().begin(key)
        joint_q = self.first_joints(physics)
        if self.scene.grasps:
            physics = physics.replace(soft=self.opened(physics.soft, self._bodies(joint_q)))
        return physics.replace(joint_q=joint_q), key

    @property
    def feeling_bodies(self) -> dict[str, int]:
        """None: colliders feel no force of cloth and ropes."""
        return {}

    @property
    def appearance(self) -> dict[str, Any]:
        return {**soft_appearance(self.scene, self.up), "thickness": self.thickness, "camera": self.camera}

    def render_shapes(self, physics: SoftPhysics) -> list[dict[str, Any]]:
        """Drawings of the tools, and a ball at each held vertex and at each grasp."""
        return [*super().render_shapes(physics), *self.holders(physics)]

    def holders(self, physics: SoftPhysics) -> list[dict[str, Any]]:
        """A ball at each held vertex and at each grasp."""
        x = self.vertices(physics)
        at = [x[i] for i in self.thin_scene.topology.held.indices[:, 0]]
        if self.scene.grasps:
            bodies = self._bodies(physics.joint_q)
            at += [
                bodies.position[grasp.body] + bodies.rotation[grasp.body] @ grasp.offset for grasp in self.scene.grasps
            ]
        return [{"kind": "sphere", "center": center, "radius": 1.2 * self.thickness, "color": GRIPPER} for center in at]

    def world(self, physics: SoftPhysics, up: np.ndarray) -> World:
        del up
        world = thin_world(self.scene, physics.soft, self.thickness)  # pyright: ignore[reportArgumentType]
        return self._with_tools(world, physics)

    @property
    def seen_colliders(self) -> tuple[Collider, ...]:
        """The tools that pictures and sensors show."""
        return self.scene.colliders

    def _with_tools(self, world: World, physics: SoftPhysics) -> World:
        """The world with the tools, and with all bodies that can carry a sensor: those of tools and of grasps."""
        if not self.seen_colliders and not self.scene.grasps:
            return world
        return with_tools(world, self.seen_colliders, self._bodies(physics.joint_q))

    def _bodies(self, joint_q: Array) -> Pose:
        """Poses of the bodies, shapes (num_bodies, 3) and (num_bodies, 3, 3), for joint_q (num_joints,)."""
        return jax.tree.map(lambda a: a[0], self.poses(joint_q[None]))

    def _driven(self, physics: SoftPhysics, action: Array, path: Array) -> tuple[Soft, Any, Array]:
        poses = checked_poses(self, self.poses(path), len(path))
        pins = self.pins(physics, path[1:]) if len(self.thin_scene.topology.held) else None
        grips = self.grips(path[1:]) if self.scene.grasps else None
        driven = {"pins": pins, "grips": grips, "store_every": self.store_every}
        soft, status = self.stepped(self.actuated(action), physics.soft, poses, **driven)
        return soft, None, status


__all__ = ["GRIPPER", "ThinTask"]
