"""Random pairs of geoms that touch or nearly touch, and distances of points from geoms."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rewax.physics.numerics.rotations import quaternion_to_matrix
from rewax.physics.rigid import Geom
from rewax.physics.shapes import Box, Capsule, Cylinder, Ellipsoid, Plane, Shape, Sphere, signed_distance
from rewax.types import Array, Key

_SMALL, _LARGE = 0.05, 0.15
"""Smallest and largest size of a geom [m]."""
_INSIDE = 0.8
"""Geoms touch within this fraction of a face or an edge, around its center."""
_CLEAR = 0.3
"""Sine of the smallest angle between two edges, and between their common normal and the normals of faces."""
_WITH_EDGES = ("capsule", "cylinder", "box")


class Touching(NamedTuple):
    """Two geoms, and the direction between their nearest points.

    Attributes:
      first, second: the geoms.
      normal: unit vector from first to second, shape (3,).
    """

    first: Geom
    second: Geom
    normal: Array


def touching(key: Key, kinds: tuple[str, str], gap: Array) -> Touching:
    """Two geoms with random sizes and rotations at distance ``gap`` [m]; they overlap if it is negative.

    One touches with a face or a curved surface, the other with its extreme point: a corner or an end, for example.
    Capsules, cylinders and boxes also touch with two edges, or sides, that cross.
    """
    keys = jax.random.split(key, 6)
    first, second = (_geom(k, kind) for k, kind in zip(keys[:2], kinds, strict=True))
    point, normal = _on_surface(keys[2], kinds[0], first)
    other = _furthest(kinds[1], second, -normal)
    found = [(point, other, normal)]
    if kinds[0] != "plane":
        other, normal = _on_surface(keys[3], kinds[1], second)
        found.append((_furthest(kinds[0], first, -normal), other, -normal))
        if set(kinds) <= set(_WITH_EDGES):
            crossing, is_clear = _crossing(keys[4], kinds, first, second)
            found.append(jax.tree.map(lambda a, b: jnp.where(is_clear, a, b), crossing, found[0]))
    choice = jax.random.randint(keys[5], (), 0, len(found))
    point, other, normal = (jnp.stack(parts)[choice] for parts in zip(*found, strict=True))
    position = first.position + point + gap * normal - other
    return Touching(first, second._replace(position=position), normal)


def stacked(kinds: tuple[str, str], lies: tuple[bool, bool], gap: float) -> Touching:
    """Two geoms of fixed sizes, the second above the first. ``lies`` says which of them lie on their side."""
    size, up = jnp.array([0.1, 0.12, 0.14]), jnp.array([0.0, 0.0, 1.0])
    turns = [jnp.eye(3), jnp.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])]
    first, second = (
        Geom(jnp.zeros(3), turns[lie and kind != "plane"], jnp.where(_used(kind), size, 0.0))
        for kind, lie in zip(kinds, lies, strict=True)
    )
    top, bottom = jnp.dot(_furthest(kinds[0], first, up), up), jnp.dot(_furthest(kinds[1], second, -up), up)
    return Touching(first, second._replace(position=up * (top + gap - bottom)), up)


def distance_to(kind: str, geom: Geom, point: Array) -> Array:
    """Signed distance of a point from a geom's surface [m], shape ()."""
    p = jnp.sum(geom.rotation * (point - geom.position)[:, None], axis=0)
    if kind in ("plane", "capsule", "cylinder"):
        p = jnp.stack([p[0], p[2], -p[1]])  # the axis of a shape is y, that of a geom is z
    return signed_distance(_shape(kind, geom.size), p)[0]


def _shape(kind: str, size: Array) -> Shape:
    match kind:
        case "sphere":
            return Sphere(radius=size[0])
        case "capsule":
            return Capsule(radius=size[0], half_length=size[1])
        case "ellipsoid":
            return Ellipsoid(semi_axes=size)
        case "cylinder":
            return Cylinder(radius=size[0], half_length=size[1])
        case "box":
            return Box(half_size=size)
    return Plane()


def _used(kind: str) -> Array:
    """Mask of the sizes that a kind of geom uses, shape (3,)."""
    return jnp.arange(3) < {"plane": 0, "sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3)


def _geom(key: Key, kind: str) -> Geom:
    keys = jax.random.split(key, 3)
    quaternion = jax.random.normal(keys[0], (4,))
    rotation = quaternion_to_matrix(quaternion / jnp.linalg.norm(quaternion))
    size = jax.random.uniform(keys[1], (3,), minval=_SMALL, maxval=_LARGE)
    return Geom(jax.random.uniform(keys[2], (3,), minval=-1.0), rotation, jnp.where(_used(kind), size, 0.0))


def _furthest(kind: str, geom: Geom, direction: Array) -> Array:
    """Vector from the center of a geom to its extreme point in a direction, shape (3,)."""
    n, size = geom.rotation.T @ direction, geom.size
    side, up = jnp.array([1.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0])
    across = n * side / jnp.maximum(jnp.linalg.norm(n * side), 1e-12)
    point = {
        "plane": jnp.zeros(3),
        "sphere": size[0] * n,
        "capsule": size[0] * n + size[1] * jnp.sign(n) * up,
        "ellipsoid": size**2 * n / jnp.maximum(jnp.linalg.norm(size * n), 1e-12),
        "cylinder": size[0] * across + size[1] * jnp.sign(n) * up,
        "box": size * jnp.sign(n),
    }[kind]
    return geom.rotation @ point


def _on_surface(key: Key, kind: str, geom: Geom) -> tuple[Array, Array]:
    """Vector from the center of a geom to a random point of its surface away from edges, and the normal there."""
    keys, size = jax.random.split(key, 3), geom.size
    up = jnp.array([0.0, 0.0, 1.0])
    n = jax.random.normal(keys[0], (3,))
    within = _INSIDE * jax.random.uniform(keys[1], (3,), minval=-1.0)
    choice = jax.random.randint(keys[2], (), 0, 6)
    axis = jnp.where(jnp.arange(3) == choice // 2, 1.0, 0.0) * jnp.where(choice % 2 == 0, 1.0, -1.0)
    radial = n * jnp.array([1.0, 1.0, 0.0])
    n, radial = n / jnp.linalg.norm(n), radial / jnp.linalg.norm(radial)
    if kind == "plane":
        return geom.rotation @ (0.1 * within * (1.0 - up)), geom.rotation @ up
    if kind in ("sphere", "ellipsoid"):
        return _furthest(kind, geom, geom.rotation @ n), geom.rotation @ n
    if kind == "box":
        return geom.rotation @ (size * jnp.where(axis != 0, axis, within)), geom.rotation @ axis
    side = size[0] * radial + size[1] * within * up
    if kind == "capsule":
        end = size[0] * n + size[1] * jnp.sign(n) * up
        normal, point = jnp.where(choice % 2 == 0, jnp.stack([radial, side]), jnp.stack([n, end]))
    else:
        cap = jnp.where(choice < 4, 1.0, -1.0) * up
        on_cap = size[0] * within[2] * radial + size[1] * cap
        normal, point = jnp.where(choice % 2 == 0, jnp.stack([radial, side]), jnp.stack([cap, on_cap]))
    return geom.rotation @ point, geom.rotation @ normal


def _crossing(key: Key, kinds: tuple[str, str], first: Geom, second: Geom) -> tuple[tuple[Array, Array, Array], Array]:
    """Vectors from the centers of two geoms to points on an edge of each, and the common normal of the edges.

    Also returns whether the edges are far from parallel to each other and to all faces: otherwise a face may touch
    first.
    """
    keys = jax.random.split(key, 4)
    numbers = [
        jax.random.randint(k, (), 0, 3) if kind == "box" else jnp.array(2)
        for k, kind in zip(keys[:2], kinds, strict=True)
    ]
    axes = [geom.rotation[:, number] for geom, number in zip((first, second), numbers, strict=True)]
    normal = jnp.cross(axes[0], axes[1])
    sine = jnp.linalg.norm(normal)
    normal = normal / jnp.maximum(sine, 1e-12)
    is_clear = sine > _CLEAR
    for geom in (first, second):
        is_clear &= jnp.max(jnp.abs(geom.rotation.T @ normal)) < 1.0 - 0.5 * _CLEAR**2
    points = []
    for k, kind, geom, number, axis, n in zip(
        keys[2:], kinds, (first, second), numbers, axes, (normal, -normal), strict=True
    ):
        half = geom.size[number] if kind == "box" else geom.size[1]
        point = _furthest(kind, geom, n)
        points.append(point + axis * (_INSIDE * half * jax.random.uniform(k, minval=-1.0) - jnp.dot(point, axis)))
    return (points[0], points[1], normal), is_clear


__all__ = ["Touching", "distance_to", "stacked", "touching"]
