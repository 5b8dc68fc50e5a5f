"""Which contacts are found by routines of our own in place of MJX's, and how MJX is made to use them."""

# pyright: reportAttributeAccessIssue=false

import contextlib
import threading
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
from mujoco.mjx._src import collision_driver
from mujoco.mjx._src.types import GeomType

from rewax.physics.rigid.box_faces import MOST, box_faces
from rewax.physics.rigid.capsule_box import capsule_box
from rewax.physics.rigid.capsules import capsule_capsule, sphere_capsule
from rewax.physics.rigid.plane_box import plane_box
from rewax.physics.rigid.plane_capsule import plane_capsule
from rewax.physics.rigid.small_products import cross
from rewax.physics.rigid.sphere_box import sphere_box
from rewax.types import Array

Geoms = tuple[Array, Array, Array]
"""Centres, rotations and sizes of n geoms, shapes (n, 3), (n, 3, 3) and (n, 3)."""

_LOCK = threading.RLock()


@contextlib.contextmanager
def own_routines(penalty: bool) -> Iterator[None]:
    """MJX finds contacts by our routines meanwhile.

    Args:
      penalty: whether under a penalty law: that has capsules and boxes of its own for explicit pairs and MJX's for
        others.
    """
    table = collision_driver._COLLISION_FUNC
    own = {kinds: routine for kinds, routine in _OWN.items() if not penalty or kinds == _PLANE_BOX}
    with _LOCK:
        theirs = {kinds: table[kinds] for kinds in own}
        table.update(own)
        try:
            yield
        finally:
            table.update(theirs)


def contact_frame(normal: Array) -> Array:
    """A right-handed frame of a normal, as MuJoCo makes it: rows normal and two tangents. (n, 3) -> (n, 3, 3).

    Gradient: exact, but where the tangent changes from about y to about z.
    """
    level = (normal[:, 1] > -0.5) & (normal[:, 1] < 0.5)
    start = jnp.where(level[:, None], jnp.array([0.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    tangent = start - normal * jnp.sum(start * normal, axis=-1, keepdims=True)
    tangent = tangent / jnp.sqrt(jnp.sum(tangent * tangent, axis=-1, keepdims=True))
    return jnp.stack([normal, tangent, cross(normal, tangent)], axis=1)


def _routine(num: int, find: Callable[[Geoms, Geoms], Geoms]) -> Callable:
    """As MJX wants it: ``num`` contacts for each pair of geoms, those of a pair one after another."""

    def collide(m, d, _, geom: Array) -> Geoms:
        first, second = ((d.geom_xpos[g], d.geom_xmat[g], m.geom_size[g]) for g in geom.T)
        distance, point, frame = find(first, second)
        return distance.reshape(-1), point.reshape(-1, 3), frame.reshape(-1, 3, 3)

    collide.ncon = num
    return collide


def _of_planes_and_boxes(plane: Geoms, box: Geoms) -> Geoms:
    normal = plane[1][:, :, 2]
    distance, point = jax.vmap(plane_box)(plane[0], normal, *box)
    return distance, point, jnp.repeat(contact_frame(normal), 4, axis=0)


def _of_planes_and_capsules(plane: Geoms, capsule: Geoms) -> Geoms:
    distance, point, frame = jax.vmap(plane_capsule)(
        plane[0], plane[1][:, :, 2], capsule[0], capsule[1][:, :, 2], capsule[2]
    )
    return distance, point, jnp.repeat(frame, 2, axis=0)


def _of_spheres_and_capsules(sphere: Geoms, capsule: Geoms) -> Geoms:
    distance, point, normal = sphere_capsule(sphere[0], sphere[2][:, 0], capsule[0], capsule[1][:, :, 2], capsule[2])
    return distance, point, contact_frame(normal)


def _of_spheres_and_boxes(sphere: Geoms, box: Geoms) -> Geoms:
    distance, point, normal = sphere_box(sphere[0], sphere[2][:, 0], *box)
    return distance, point, contact_frame(normal)


def _of_capsules(first: Geoms, second: Geoms) -> Geoms:
    lines = [(center, rotation[:, :, 2], size) for center, rotation, size in (first, second)]
    distance, point, normal = capsule_capsule(
        *lines[0], *lines[1], parallel=10.0 * float(jnp.finfo(first[0].dtype).eps)
    )
    return distance, point, contact_frame(normal)


def _of_capsules_and_boxes(capsule: Geoms, box: Geoms) -> Geoms:
    distance, point, normal = jax.vmap(capsule_box)(capsule[0], capsule[1][:, :, 2], capsule[2], *box)
    return distance, point, contact_frame(normal.reshape(-1, 3))


def _of_boxes(first: Geoms, second: Geoms) -> Geoms:
    distance, point, normal = jax.vmap(box_faces)(*first, *second)
    return distance, point, jnp.repeat(contact_frame(normal), MOST, axis=0)


_PLANE_BOX = (GeomType.PLANE, GeomType.BOX)
_OWN = {
    _PLANE_BOX: _routine(4, _of_planes_and_boxes),
    (GeomType.PLANE, GeomType.CAPSULE): _routine(2, _of_planes_and_capsules),
    (GeomType.SPHERE, GeomType.CAPSULE): _routine(1, _of_spheres_and_capsules),
    (GeomType.SPHERE, GeomType.BOX): _routine(1, _of_spheres_and_boxes),
    (GeomType.CAPSULE, GeomType.CAPSULE): _routine(1, _of_capsules),
    (GeomType.CAPSULE, GeomType.BOX): _routine(2, _of_capsules_and_boxes),
    (GeomType.BOX, GeomType.BOX): _routine(MOST, _of_boxes),
}

__all__ = ["contact_frame", "own_routines"]
