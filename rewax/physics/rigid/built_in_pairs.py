"""Pairs of geom kinds that rewax collides itself. MJX collides all others."""

import jax.numpy as jnp

from rewax.physics.rigid.box_faces import MOST, box_faces
from rewax.physics.rigid.capsule_box import capsule_box
from rewax.physics.rigid.capsules import capsule_capsule, sphere_capsule
from rewax.physics.rigid.contact_pair import ContactPair, Geom
from rewax.physics.rigid.plane_box import plane_box
from rewax.physics.rigid.plane_capsule import plane_capsule
from rewax.physics.rigid.sphere_box import sphere_box
from rewax.types import Array

_Found = tuple[Array, Array, Array]


def _plane_box(plane: Geom, box: Geom) -> _Found:
    normal = plane.rotation[:, 2]
    distance, point = plane_box(plane.position, normal, *box)
    return distance, point, normal


def _plane_capsule(plane: Geom, capsule: Geom) -> _Found:
    distance, point, frame = plane_capsule(
        plane.position, plane.rotation[:, 2], capsule.position, capsule.rotation[:, 2], capsule.size
    )
    return distance, point, jnp.repeat(frame[None], 2, axis=0)


def _sphere_capsule(sphere: Geom, capsule: Geom) -> _Found:
    return sphere_capsule(sphere.position, sphere.size[0], capsule.position, capsule.rotation[:, 2], capsule.size)


def _sphere_box(sphere: Geom, box: Geom) -> _Found:
    return sphere_box(sphere.position, sphere.size[0], *box)


def _capsule_capsule(first: Geom, second: Geom) -> _Found:
    """As in MuJoCo: the contact moves to the middle only if the axes are parallel up to rounding."""
    parallel = 10.0 * float(jnp.finfo(first.position.dtype).eps)
    lines = [(geom.position, geom.rotation[:, 2], geom.size) for geom in (first, second)]
    return capsule_capsule(*lines[0], *lines[1], parallel=parallel)


def _capsule_box(capsule: Geom, box: Geom) -> _Found:
    return capsule_box(capsule.position, capsule.rotation[:, 2], capsule.size, *box)


def _box_box(first: Geom, second: Geom) -> _Found:
    return box_faces(*first, *second)


BUILT_IN_PAIRS = (
    ContactPair(("plane", "capsule"), 2, _plane_capsule),
    ContactPair(("plane", "box"), 4, _plane_box),
    ContactPair(("sphere", "capsule"), 1, _sphere_capsule),
    ContactPair(("sphere", "box"), 1, _sphere_box),
    ContactPair(("capsule", "capsule"), 1, _capsule_capsule),
    ContactPair(("capsule", "box"), 2, _capsule_box),
    ContactPair(("box", "box"), MOST, _box_box),
)  # fmt: skip
"""Pairs that rewax collides itself; with a ``Penalty`` only plane and box."""
UNDER_A_PENALTY = tuple(pair for pair in BUILT_IN_PAIRS if pair.kinds == ("plane", "box"))
"""Built-in pairs under a penalty law. ``forces.contacts`` collides explicit pairs of other kinds, and MJX the rest."""

__all__ = ["BUILT_IN_PAIRS", "UNDER_A_PENALTY"]
