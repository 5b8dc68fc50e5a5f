"""Self-contact in a step: the search for close pairs, their forces, and what ``check_status`` says about them."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.substeps import check_store_every
from rewax.physics.thin import broad_phase, closest, pair_law
from rewax.physics.thin.contact_elements import ContactElements
from rewax.physics.thin.pair_law import SelfContact
from rewax.types import Array, Scalar

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene

T = TypeVar("T")

NO_PAIR = -1.0
"""Thickness of entries of a list that are no pairs: nothing is that close."""


class Pairs(NamedTuple):
    """Close pairs of one kind, in lists of fixed length."""

    corners: Array
    """Vertices of both elements, int32 of shape (4, capacity)."""
    thickness: Array
    """Distance at which a pair touches [m], shape (capacity,)."""


class AllPairs(NamedTuple):
    """Close pairs of both kinds."""

    triangles: Pairs | None
    """A vertex and the corners of a triangle; None in scenes of ropes."""
    edges: Pairs
    """The ends of two edges or segments."""


# --- Search -----------------------------------------------------------------------------------------------------------


def close_pairs(scene: "ThinScene", x: Vec3) -> AllPairs:
    """The pairs that can touch within the next ``every`` substeps.

    Gradient: exact with respect to the thickness. The choice of pairs is a constant.
    """
    law, elements = _law(scene), scene.contact_elements
    assert elements is not None
    triangles, edges, _ = search(scene, x)
    of_vertex, of_edge, of_triangle = half_thickness(law, elements)

    def pairs(found: broad_phase.Found, tables: Any, halves: Any) -> Pairs:
        corners = [jnp.asarray(t)[:, k] for t, k in zip(tables, (found.first, found.second), strict=True)]
        thickness = halves[0][found.first] + halves[1][found.second]
        return Pairs(jnp.concatenate(corners), jnp.where(found.valid, thickness, NO_PAIR))

    tables = (np.arange(elements.num_vertices)[None], elements.triangles.T)
    return AllPairs(
        None if triangles is None else pairs(triangles, tables, (of_vertex, of_triangle)),
        pairs(edges, (elements.edges.T, elements.edges.T), (of_edge, of_edge)),
    )


def search(scene: "ThinScene", x: Vec3) -> tuple[broad_phase.Found | None, broad_phase.Found, Array]:
    """Close pairs of vertices with triangles (None without triangles) and of edges, and the excess of their lists."""
    scene, x = jax.lax.stop_gradient((scene, x))
    law, elements = _law(scene), scene.contact_elements
    assert elements is not None
    skin = 2.0 * law.max_speed * law.every * scene.dt
    halves = half_thickness(law, elements)
    room = law.pairs_per_element
    at = jnp.stack(x)
    vertices, edges, triangles = elements.orders

    def boxes(corners: np.ndarray, half: Array) -> broad_phase.Boxes:
        return broad_phase.boxes_of(at, corners, half + 0.5 * skin)

    capacity = room * len(elements.edges)
    found = broad_phase.overlapping(
        boxes(elements.edges, halves[1]), None, (edges, edges), elements.levels, _WIDER * capacity
    )
    near = _is_near(elements.near_edges, found)
    reach = halves[1][found.first] + halves[1][found.second] + skin
    gap = _edge_distance(elements, x, found)
    edge_pairs = broad_phase.kept(found, ~near & (gap < reach), capacity)
    if not len(elements.triangles):
        return None, edge_pairs, edge_pairs.excess
    capacity = room * elements.num_vertices
    found = broad_phase.overlapping(
        boxes(np.arange(elements.num_vertices)[:, None], halves[0]),
        boxes(elements.triangles, halves[2]),
        (vertices, triangles),
        elements.levels,
        _WIDER * capacity,
    )
    near = _is_near(elements.near_triangles, found)
    reach = halves[0][found.first] + halves[2][found.second] + skin
    gap = _triangle_distance(elements, x, found)
    triangle_pairs = broad_phase.kept(found, ~near & (gap < reach), capacity)
    return triangle_pairs, edge_pairs, jnp.maximum(triangle_pairs.excess, edge_pairs.excess)


_WIDER = 4
"""Pairs of overlapping boxes for each close pair, for which the search has room."""


def half_thickness(law: SelfContact, elements: ContactElements) -> tuple[Array, Array, Array]:
    """Half of the thickness [m] of vertices, edges and triangles. Gradient: exact."""
    cloth, rope = 0.5 * jnp.asarray(law.thickness), 0.5 * jnp.asarray(law.rope())
    return (
        jnp.where(elements.in_rope, rope, cloth),
        jnp.where(elements.is_rope, rope, cloth),
        jnp.broadcast_to(cloth, (len(elements.triangles),)),
    )


def _is_near(table: np.ndarray, found: broad_phase.Found) -> Array:
    """Whether the second element is a neighbour of the first."""
    near = jnp.bool_(False)
    for column in table.T:
        near = near | (jnp.asarray(column)[found.first] == found.second)
    return near


def gather_corners(x: Vec3, table: np.ndarray, ids: Array) -> tuple[Vec3, ...]:
    return tuple(cp.vector(lambda i, c=c: x[i][jnp.asarray(c)[ids]]) for c in table.T)


def _edge_distance(elements: ContactElements, x: Vec3, found: broad_phase.Found) -> Array:
    at = (*gather_corners(x, elements.edges, found.first), *gather_corners(x, elements.edges, found.second))
    return cp.norm(closest.weighted(closest.segments(at, _TINY * cp.norm(cp.subtract(at[1], at[0]))), at))


def _triangle_distance(elements: ContactElements, x: Vec3, found: broad_phase.Found) -> Array:
    at = (cp.vector(lambda i: x[i][found.first]), *gather_corners(x, elements.triangles, found.second))
    return cp.norm(closest.weighted(closest.vertex_triangle(at), at))


_TINY = 1e-3
"""Smoothing over the first edge's length in the search; the skin is larger."""


# --- Forces -----------------------------------------------------------------------------------------------------------


def self_forces(scene: "ThinScene", x: Vec3, v: Vec3, pairs: AllPairs) -> Vec3:
    """Forces of self-contact on the vertices [N]; they and their torques sum to zero. Gradient: exact."""
    law = pair_law.numbers(_law(scene))
    kinds = [
        (pair_law.vertex_triangle_force, pairs.triangles),
        (pair_law.segments_force, pairs.edges),
    ]
    kinds = [(force, kind) for force, kind in kinds if kind is not None and kind.thickness.size]
    out = cp.vector(lambda i: jnp.zeros_like(x[i]))
    for force, kind in kinds:
        corners = kind.corners
        at, moving = (
            tuple(cp.vector(lambda i, u=u, c=c: u[i].at[c].get(mode="promise_in_bounds")) for c in corners)
            for u in (x, v)
        )
        each = force(law, (at, moving, kind.thickness))
        out = cp.vector(
            lambda i, out=out, each=each, corners=corners: (
                out[i]
                .at[corners.reshape(-1)]
                .add(jnp.concatenate([corner[i] for corner in each]), mode="promise_in_bounds")
            )
        )
    return out


def scan_rounds(
    substep: Callable[[T, Any, AllPairs], T],
    search: Callable[[T], AllPairs],
    carry: T,
    intervals: Any,
    store_every: int | None,
    every: int,
) -> T:
    """``numerics.substeps.scan_substeps`` with a search for pairs before each round of at most ``every`` substeps."""
    total = jax.tree.leaves(intervals)[0].shape[0]
    if store_every is not None:
        check_store_every(store_every, total)
    chunk = total if store_every in (None, 1) else store_every
    each = max(d for d in range(1, min(every, chunk) + 1) if chunk % d == 0)

    def one_round(carry: T, intervals: Any) -> tuple[T, None]:
        pairs = search(carry)
        return jax.lax.scan(lambda c, interval: (substep(c, interval, pairs), None), carry, intervals)[0], None

    def one_chunk(carry: T, rounds: Any) -> tuple[T, None]:
        return jax.lax.scan(one_round, carry, rounds)

    chunks = jax.tree.map(lambda a: a.reshape(total // chunk, chunk // each, each, *a.shape[1:]), intervals)
    if chunk == total and store_every in (None, 1):
        return one_chunk(carry, jax.tree.map(lambda a: a[0], chunks))[0]
    return jax.lax.scan(jax.checkpoint(one_chunk), carry, chunks)[0]


def _law(scene: "ThinScene") -> SelfContact:
    assert scene.self_contact is not None
    return scene.self_contact


__all__ = [
    "AllPairs",
    "Pairs",
    "close_pairs",
    "gather_corners",
    "half_thickness",
    "scan_rounds",
    "search",
    "self_forces",
]
