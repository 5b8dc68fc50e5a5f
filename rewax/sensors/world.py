"""The world that sensors observe: solids by their shapes, particles as balls, surfaces of triangles."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rewax import struct
from rewax.physics.contact.colliders import Collider, shape_pose
from rewax.physics.contact.patches import Wrench
from rewax.physics.numerics.pose import Pose, body_pose
from rewax.physics.shapes import Plane, Shape
from rewax.types import Array, Scalar

NOTHING = -1
"""Label of pixels where nothing is seen."""


@struct.dataclass
class Solid(struct.Replaceable):
    """A shape at a place.

    Attributes:
      shape: its signed distance, in its own frame.
      pose: of the shape's frame in the world, shapes (3,) and (3, 3).
      name: of the body that it belongs to (static).
    """

    shape: Shape
    pose: Pose
    name: str = struct.static_field()


@struct.dataclass
class Balls(struct.Replaceable):
    """Particles, seen as balls of one radius.

    Attributes:
      center: [m], shape (num_balls, 3).
      radius: [m]; from it the program knows how many pixels a ball can cover (static).
      names: of the bodies that they belong to, one after the other (static).
      counts: how many balls each of these bodies has (static).
    """

    center: Array
    radius: float = struct.static_field()
    names: tuple[str, ...] = struct.static_field()
    counts: tuple[int, ...] = struct.static_field()


@struct.dataclass
class Triangles(struct.Replaceable):
    """A surface, seen from both sides.

    Attributes:
      vertices: [m], shape (num_vertices, 3).
      faces: indices of vertices, int32, shape (num_faces, 3).
      name: of the body (static).
    """

    vertices: Array
    faces: Array
    name: str = struct.static_field()


@struct.dataclass
class World(struct.Replaceable):
    """The visible objects, and the bodies that sensors can be mounted on.

    Attributes:
      solids, balls, triangles: what there is.
      bodies: poses of all bodies, shapes (num_bodies, 3) and (num_bodies, 3, 3); None: none can carry a sensor.
      felt: mean force and torque of the last control step on the patches of one ``Touch``; None for other sensors.
    """

    solids: tuple[Solid, ...] = ()
    balls: tuple[Balls, ...] = ()
    triangles: tuple[Triangles, ...] = ()
    bodies: Pose | None = None
    felt: Wrench | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all visible objects, each once; a label is an index into this tuple."""
        every = [
            *(solid.name for solid in self.solids),
            *(name for balls in self.balls for name in balls.names),
            *(surface.name for surface in self.triangles),
        ]
        return tuple(dict.fromkeys(every))

    def label(self, name: str) -> int:
        """The index of a name.

        Raises:
          ValueError: nothing has this name.
        """
        if name not in self.names:
            raise ValueError(f"of has {name!r}, which nothing is named: use {', '.join(self.names)}")
        return self.names.index(name)

    def body(self, index: int) -> Pose:
        """Pose of one body.

        Raises:
          ValueError: there is no such body.
        """
        count = 0 if self.bodies is None else len(self.bodies.position)
        if count == 0:
            raise ValueError(f"body is {index}, but no body of this world can carry a sensor: give None")
        if self.bodies is None or not 0 <= index < count:
            raise ValueError(f"body is {index}, but {count} bodies can carry a sensor: give a body from 0 on, or None")
        return body_pose(self.bodies, index)


def placed_colliders(colliders: Sequence[Collider], bodies: Pose, name: str = "tool") -> tuple[Solid, ...]:
    """Colliders as solids.

    Args:
      colliders: of a scene.
      bodies: poses of the bodies that carry them, shapes (num_bodies, 3), (num_bodies, 3, 3).
      name: of all.

    Gradient: exact with respect to poses and sizes.
    """
    return tuple(Solid(shape=c.shape, pose=shape_pose(c, body_pose(bodies, c.body)), name=name) for c in colliders)


def half_space(normal: Sequence[float], height: Scalar, name: str) -> Solid:
    """The half-space normal . x < height: a floor, or a wall.

    Args:
      normal: unit vector that points out of it, shape (3,).
      height: distance of the plane from the origin along the normal [m], shape ().
      name: of the solid.

    Gradient: exact with respect to ``height``; ``normal`` is a constant.
    """
    up = np.asarray(normal, float)
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side = side / np.linalg.norm(side)
    rotation = np.stack([side, up, np.cross(side, up)], axis=1)
    return Solid(shape=Plane(), pose=Pose(jnp.asarray(up, float) * height, jnp.asarray(rotation, float)), name=name)


def frozen(world: World) -> World:
    """The same world without gradients."""
    return jax.tree.map(jax.lax.stop_gradient, world)
