"""Soft bodies in pictures: names of materials, speed and strain of each particle, height of the floor."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from rewax.physics import tets
from rewax.physics.mpm import MPMScene, MPMState
from rewax.physics.tets import TetScene, TetState
from rewax.physics.thin import ThinScene, ThinState
from rewax.types import Array

MARKER = (0.90, 0.25, 0.20)
"""Colour of targets and other markers without contact: red, green and blue."""


def soft_appearance(scene: MPMScene | TetScene | ThinScene, up: np.ndarray) -> dict[str, Any]:
    """The part of a picture that is constant during an episode, with the keys of ``rewax.viz.recording.Recording``.

    Args:
      scene: the soft bodies, walls and ground.
      up: unit vector that points up, shape (3,).
    """
    if isinstance(scene, TetScene):
        mesh = tets.TetMesh(np.zeros((0, 3)), scene.tets)
        active = np.any(np.asarray(scene.activation) != 0.0)
        looks: dict[str, Any] = {
            "triangles": np.asarray(tets.boundary_faces(mesh)),
            "material_names": ("muscle" if active else "elastic",),
        }
        return {**looks, **_floor(scene, up)}
    if isinstance(scene, ThinScene):
        return {**_thin_looks(scene), **_floor(scene, up)}
    parts = scene.material if isinstance(scene.material, tuple) else (scene.material,)
    looks = {"material_names": unique_names([part.look for part in parts])}
    if scene.particle_counts is not None:
        looks["materials"] = np.repeat(np.arange(len(parts)), scene.particle_counts)
    axis = int(np.argmax(np.abs(up)))
    wall = (scene.walls.lower if up[axis] > 0 else scene.walls.upper)[axis]
    if wall is not None and abs(up[axis]) > 0.99:
        looks["floor"] = float(np.sign(up[axis]) * wall.position)
    return looks


def _floor(scene: TetScene | ThinScene, up: np.ndarray) -> dict[str, float]:
    """Height of level ground."""
    if scene.ground is None or float(np.asarray(scene.ground.normal) @ up) <= 0.99:
        return {}
    return {"floor": float(np.asarray(scene.ground.height))}


def _thin_looks(scene: ThinScene) -> dict[str, Any]:
    """Triangles of cloth, segments of ropes, and which vertices belong to ropes alone."""
    triangles, segments = scene.topology.triangles.indices, scene.topology.segments.indices
    names = tuple(name for name, part in (("cloth", triangles), ("rope", segments)) if len(part))
    looks: dict[str, Any] = {"material_names": names}
    if len(triangles):
        looks["triangles"] = triangles
    if len(segments):
        looks["segments"] = segments
    if len(names) > 1:
        looks["materials"] = np.where(np.isin(np.arange(scene.topology.triangles.num_vertices), triangles), 0, 1)
    return looks


def unique_names(names: Sequence[str]) -> tuple[str, ...]:
    """The names with ``_2``, ``_3``, ... after those that repeat: ``("elastic", "elastic_2", "water")``."""
    return tuple(name if (n := names[:i].count(name)) == 0 else f"{name}_{n + 1}" for i, name in enumerate(names))


def soft_values(soft: MPMState | TetState | ThinState) -> dict[str, Array]:
    """Speed [m/s] of each point and strain [-] of each particle, shape (num_points,).

    The strain is the Frobenius norm of the Green-Lagrange strain (F^T F - I) / 2.
    """
    values = {"speed": jnp.sqrt(jnp.sum(soft.v**2, axis=-1))}
    if isinstance(soft, MPMState):
        green = 0.5 * (jnp.einsum("nki,nkj->nij", soft.F, soft.F) - jnp.eye(3, dtype=soft.F.dtype))
        values["strain"] = jnp.sqrt(jnp.sum(green**2, axis=(-2, -1)))
    return values
