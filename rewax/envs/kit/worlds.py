"""The worlds that sensors of the kit's tasks observe."""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np

from rewax.envs.kit.appearance import unique_names
from rewax.physics import tets
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Plane
from rewax.physics.tets import TetScene
from rewax.physics.thin import ThinScene, ThinState
from rewax.sensors.world import Balls, Solid, Triangles, World, half_space, placed_colliders
from rewax.types import Array, Scalar

BALL_RADIUS = 0.4
"""Radius of a drawn particle, in cells of the grid. With eight in a cell, neighbours on the diagonal overlap."""
BALLS_PER_SEGMENT = 6
"""Balls that stand for one segment of a rope."""


def soft_world(scene: Any, soft: Any, up: np.ndarray) -> World:
    """Particles or the surface of tetrahedra, and the floor: the wall or ground below.

    Args:
      scene: ``MPMScene`` or ``TetScene``: the soft bodies and what bounds them.
      soft: ``MPMState`` or ``TetState``: where they are.
      up: unit vector against gravity, shape (3,).
    """
    if isinstance(scene, TetScene):
        faces, floor = jnp.asarray(_faces(scene.topology), jnp.int32), _grounds(scene)
        return World(solids=floor, triangles=(Triangles(vertices=soft.x, faces=faces, name="soft"),))
    parts = scene.material if isinstance(scene.material, tuple) else (scene.material,)
    counts = scene.particle_counts or (soft.x.shape[0],)
    names = unique_names([part.look for part in parts])
    balls = Balls(center=soft.x, radius=BALL_RADIUS * scene.grid.spacing, names=names, counts=tuple(counts))
    axis = int(np.argmax(np.abs(up)))
    wall = (scene.walls.lower if up[axis] > 0 else scene.walls.upper)[axis]
    floor = ()
    if wall is not None and abs(up[axis]) > 0.99:
        normal = np.sign(up[axis]) * np.eye(3)[axis]
        floor = (half_space(normal, float(np.sign(up[axis]) * wall.position), "floor"),)
    return World(solids=floor, balls=(balls,))


def thin_world(scene: ThinScene, soft: ThinState, thickness: float) -> World:
    """Cloth by its triangles, ropes as rows of balls, and the ground.

    Args:
      scene: the bodies and the ground.
      soft: where they are.
      thickness: of ropes [m].
    """
    triangles, segments = scene.topology.triangles.indices, scene.topology.segments.indices
    cloth, ropes = (), ()
    if len(triangles):
        cloth = (Triangles(vertices=soft.x, faces=jnp.asarray(triangles), name="cloth"),)
    if len(segments):
        part = jnp.linspace(0.0, 1.0, BALLS_PER_SEGMENT, endpoint=False)[:, None, None]
        a, b = (soft.x[segments[:, k]] for k in (0, 1))
        centers = ((1.0 - part) * a + part * b).reshape(-1, 3)
        ropes = (Balls(center=centers, radius=0.5 * thickness, names=("rope",), counts=(len(centers),)),)
    return World(solids=_grounds(scene), balls=ropes, triangles=cloth)


def _grounds(scene: TetScene | ThinScene) -> tuple[Solid, ...]:
    return () if scene.ground is None else (_ground(scene.ground.normal, scene.ground.height),)


def with_tools(world: World, colliders: Any, bodies: Pose) -> World:
    """The world with colliders of bodies at these poses, shapes (num_bodies, 3) and (num_bodies, 3, 3)."""
    return world.replace(solids=(*world.solids, *placed_colliders(colliders, bodies)), bodies=bodies)


def _ground(normal: Array, height: Scalar) -> Solid:
    """Its normal is data, so the rotation is that which takes y to it."""
    side = jnp.where(jnp.abs(normal[0]) < 0.9, jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    side = jnp.cross(normal, side)
    side = side / jnp.linalg.norm(side)
    rotation = jnp.stack([side, normal, jnp.cross(side, normal)], axis=1)
    return Solid(shape=Plane(), pose=Pose(normal * height, rotation), name="floor")


@functools.lru_cache(maxsize=64)
def _faces(topology: Any) -> np.ndarray:
    return np.asarray(tets.boundary_faces(tets.TetMesh(np.zeros((0, 3)), topology.tets)))
