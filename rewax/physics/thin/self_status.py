"""Status bits of self-contact: full lists of pairs, layers that have crossed, vertices that are too fast."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.thin import broad_phase, closest
from rewax.physics.thin.contact_elements import ContactElements
from rewax.physics.thin.pair_kernels import CloseElements
from rewax.physics.thin.safe_speed import largest_safe_speed
from rewax.physics.thin.self_contact import find, relative_speed
from rewax.status import Status, flag
from rewax.types import Array, Scalar

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene, ThinState

TOO_DEEP = 0.25
"""Distance of the middle lines of ropes over their thickness below which they count as crossed."""
COINCIDENT = 1e-3
"""Distance of two layers over their thickness below which they count as crossed. Where it is zero, the force that
should part them has no direction, so they stay where they are."""


def self_status(scene: "ThinScene", state: "ThinState") -> Array:
    """``FULL_PAIRS`` and ``CROSSED``, shape (), int32; 0 without self-contact. Gradient: none."""
    law, elements = scene.self_contact, scene.contact_elements
    if law is None or elements is None:
        return flag(jnp.bool_(False), Status.OK)
    scene, state = jax.lax.stop_gradient((scene, state))
    x = cp.split_vector(state.x)
    edges = find(scene, x, False)
    full = (state.filled > 1.0) | (edges.count > edges.first.size)
    speed = jnp.maximum(state.speed, relative_speed(scene.mass, cp.split_vector(state.v)))
    # A scene that was changed after it was built may be safe only at lower speeds.
    limit = jnp.minimum(law.max_speed, (1.0 + 1e-5) * largest_safe_speed(scene))
    bad = (speed > limit) | ropes_crossed(elements, law.rope(), x, edges)
    if len(elements.triangles):
        corners = find(scene, x, True)
        crossed, missed = cloth_crossed(elements, x, law.pairs_per_element * len(elements.edges))
        bad = bad | crossed | layers_coincide(elements, law.thickness, x, corners)
        full = full | missed | (corners.count > corners.first.size)
    return flag(full, Status.FULL_PAIRS) | flag(bad, Status.CROSSED)


def cloth_crossed(elements: ContactElements, x: Vec3, capacity: int) -> tuple[Array, Array]:
    """Whether an edge or segment intersects a triangle, and whether ``capacity`` was too small to tell."""
    at = jnp.stack(x)
    edges, triangles = elements.kinds(False)[0], elements.kinds(True)[1]
    boxes = [broad_phase.boxes_of(at, kind.corners, jnp.zeros((), at.dtype)) for kind in (edges, triangles)]
    found = broad_phase.overlapping(boxes[0], boxes[1], (edges.order, triangles.order), elements.levels, 4 * capacity)
    ends = broad_phase.gather_corners(at, edges, found.first)
    corners = broad_phase.gather_corners(at, triangles, found.second)
    shares = jnp.bool_(False)
    for end in elements.edges.T:
        for corner in elements.triangles.T:
            shares = shares | (jnp.asarray(end)[found.first] == jnp.asarray(corner)[found.second])
    return jnp.any(found.valid & ~shares & intersects(ends, corners)), found.excess > 0


def intersects(ends: tuple[Vec3, ...], corners: tuple[Vec3, ...]) -> Array:
    """Whether segments pass through triangles, by the signs of volumes."""
    (p, q), (a, b, c) = ends, corners

    def volume(u: Vec3, v: Vec3, w: Vec3, z: Vec3) -> Array:
        return cp.dot(cp.cross(cp.subtract(v, u), cp.subtract(w, u)), cp.subtract(z, u))

    sides = volume(a, b, c, p) * volume(a, b, c, q) < 0
    around = [volume(p, q, *pair) for pair in ((a, b), (b, c), (c, a))]
    positive = (around[0] > 0) & (around[1] > 0) & (around[2] > 0)
    negative = (around[0] < 0) & (around[1] < 0) & (around[2] < 0)
    return sides & (positive | negative)


def layers_coincide(elements: ContactElements, thickness: Scalar, x: Vec3, found: CloseElements) -> Array:
    """Whether a vertex lies on a triangle of another layer, at less than ``COINCIDENT`` of the thickness."""
    at, (vertices, triangles) = jnp.stack(x), elements.kinds(True)
    corners = (
        *broad_phase.gather_corners(at, vertices, found.first),
        *broad_phase.gather_corners(at, triangles, found.second),
    )
    gap = cp.norm(closest.weighted(closest.vertex_triangle(corners), corners))
    return jnp.any((jnp.arange(found.first.size) < found.count) & (gap < COINCIDENT * thickness))


def ropes_crossed(elements: ContactElements, thickness: Scalar, x: Vec3, found: CloseElements) -> Array:
    """Whether the middle lines of two segments of ropes are closer than ``TOO_DEEP``."""
    if not np.any(elements.is_rope):
        return jnp.bool_(False)
    at, edges = jnp.stack(x), elements.kinds(False)[0]
    corners = (
        *broad_phase.gather_corners(at, edges, found.first),
        *broad_phase.gather_corners(at, edges, found.second),
    )
    smoothing = jnp.asarray(1e-3 * thickness, at.dtype)
    gap = cp.norm(closest.weighted(closest.segments(corners, smoothing), corners))
    is_rope = jnp.asarray(elements.is_rope)
    both = is_rope[found.first] & is_rope[found.second] & (jnp.arange(found.first.size) < found.count)
    return jnp.any(both & (gap < TOO_DEEP * thickness))


__all__ = ["cloth_crossed", "intersects", "layers_coincide", "ropes_crossed", "self_status"]
