"""Self-contact in a step: the search for close pairs, their forces, and what ``check_status`` says about them."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.stencils import Listed
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.numerics.substeps import check_has_substeps, check_store_every
from rewax.physics.thin import pair_law
from rewax.physics.thin.contact_elements import ContactElements
from rewax.physics.thin.pair_kernels import CloseElements, find_pairs
from rewax.physics.thin.pair_law import SelfContact
from rewax.types import Array, PyTree

if TYPE_CHECKING:
    from rewax.physics.thin.scene import ThinScene


class Moving(Protocol):
    """Vertices by components."""

    @property
    def x(self) -> Vec3: ...
    @property
    def v(self) -> Vec3: ...


T = TypeVar("T")

NO_PAIR = -1.0
"""Thickness of entries of a list that are no pairs: nothing is that close."""


class Pairs(NamedTuple):
    """Close pairs of one kind, in lists of fixed length."""

    corners: Array
    """Vertices of both elements, int32 of shape (4, capacity)."""
    thickness: Array
    """Distance at which a pair touches [m], shape (capacity,)."""
    count: Array  # pyright: ignore[reportIncompatibleMethodOverride]
    """Number of pairs, shape (), int32; above the capacity, some are missing."""

    def listed(self, num_vertices: int) -> Listed:
        """The pairs as elements of a scene with so many vertices."""
        return Listed(self.corners, self.count, num_vertices)


class AllPairs(NamedTuple):
    """Close pairs of both kinds."""

    triangles: Pairs | None
    """A vertex and the corners of a triangle; None in scenes of ropes."""
    edges: Pairs
    """The ends of two edges or segments."""


class Seen(NamedTuple):
    """Extremes of self-contact: they tell ``check_status`` whether a pair may have been missed. Gradient: none."""

    filled: Array
    """Largest number of close pairs over the length of their list [-], shape ()."""
    speed: Array
    """Largest speed of a vertex relative to the mean velocity [m/s], shape ()."""


# --- Search -----------------------------------------------------------------------------------------------------------


def close_pairs(scene: "ThinScene", x: Vec3) -> AllPairs:
    """The pairs that can touch within the next ``every`` substeps.

    Gradient: exact with respect to the thickness. The choice of pairs is a constant.
    """
    return _pairs_and_filled(scene, x)[0]


def watched_pairs(scene: "ThinScene", start: Moving) -> tuple[AllPairs, Callable[[Moving, int], Seen]]:
    """``close_pairs`` of vertices by components, and ``(end, substeps) -> seen`` for the round that they begin."""
    pairs, filled = _pairs_and_filled(scene, start.x)
    return pairs, lambda end, substeps: Seen(filled, _round_speed(scene, start, end, substeps))


def _pairs_and_filled(scene: "ThinScene", x: Vec3) -> tuple[AllPairs, Array]:
    """``close_pairs`` and ``Seen.filled``."""
    law, elements = _parts(scene)
    halves = 0.5 * jnp.stack([jnp.asarray(law.thickness), jnp.asarray(law.rope())]).astype(x[0].dtype)

    def pairs(with_triangles: bool) -> tuple[Pairs, Array]:
        found, kinds = find(scene, x, with_triangles), elements.kinds(with_triangles)
        ids = (found.first, found.second)
        corners = [jnp.asarray(kind.corners.T)[:, k] for kind, k in zip(kinds, ids, strict=True)]
        own = [halves[jnp.asarray(kind.is_rope.astype(np.int32))[k]] for kind, k in zip(kinds, ids, strict=True)]
        valid = jnp.arange(found.first.size) < found.count
        filled = found.count.astype(x[0].dtype) / found.first.size
        return Pairs(jnp.concatenate(corners), jnp.where(valid, own[0] + own[1], NO_PAIR), found.count), filled

    edges, filled = pairs(False)
    if not len(elements.triangles):
        return AllPairs(None, edges), filled
    triangles, of_triangles = pairs(True)
    return AllPairs(triangles, edges), jnp.maximum(filled, of_triangles)


def find(scene: "ThinScene", x: Vec3, with_triangles: bool) -> CloseElements:
    """Close pairs of vertices with triangles, or of edges. Gradient: none."""
    law, elements = _parts(scene)
    skin = 2.0 * law.max_speed * law.every * scene.dt
    lengths = jnp.stack([0.5 * jnp.asarray(law.thickness), 0.5 * jnp.asarray(law.rope()), jnp.asarray(skin)])
    capacity = elements.capacity(with_triangles, law.pairs_per_element)
    return find_pairs(elements, x, lengths, with_triangles=with_triangles, capacity=capacity)


# --- Forces -----------------------------------------------------------------------------------------------------------


def self_forces(scene: "ThinScene", x: Vec3, v: Vec3, pairs: AllPairs) -> Vec3:
    """Forces of self-contact on the vertices [N]; they sum to zero. Gradient: exact."""
    law = pair_law.numbers(_parts(scene)[0])
    kinds = ((pair_law.vertex_triangle_force, pairs.triangles), (pair_law.segments_force, pairs.edges))
    total = cp.vector(lambda i: jnp.zeros_like(x[i]))
    for force, kind in kinds:
        if kind is None:
            continue
        total = cp.add(total, force(kind.listed(x[0].shape[-1]), law, kind.thickness, (x, v)))
    return total


def scan_rounds(
    substep: Callable[[T, Any, Any], T],
    search: Callable[[T], tuple[Any, Callable[[T, int], PyTree]]],
    carry: T,
    intervals: Any,
    store_every: int | None,
    every: int,
) -> tuple[T, PyTree]:
    """``numerics.substeps.scan_substeps`` with a search before each round of at most ``every`` substeps.

    Args:
      search: ``carry -> pairs, watch``. ``substep`` gets the pairs; ``watch(end, substeps) -> seen`` gets the carry
        after the round.

    Returns:
      The last carry, and of each number in ``seen`` the largest of all rounds.
    """
    rounds, plain = _in_rounds(intervals, store_every, every)
    substeps = jax.tree.leaves(rounds)[0].shape[2]

    def one_round(carry: T, intervals: Any) -> tuple[T, PyTree]:
        pairs, watch = search(carry)
        end = jax.lax.scan(lambda c, interval: (substep(c, interval, pairs), None), carry, intervals)[0]
        return end, watch(end, substeps)

    end, seen = _scan(one_round, carry, rounds, plain)
    return end, jax.tree.map(jnp.max, seen)


def _in_rounds(intervals: Any, store_every: int | None, every: int) -> tuple[Any, bool]:
    """Intervals by (chunk, round, substep), and whether there is but one chunk, of which nothing is recomputed."""
    total = jax.tree.leaves(intervals)[0].shape[0]
    check_has_substeps(total)
    if store_every is not None:
        check_store_every(store_every, total)
    chunk = total if store_every in (None, 1) else store_every
    each = max(d for d in range(1, min(every, chunk) + 1) if chunk % d == 0)
    chunks = jax.tree.map(lambda a: a.reshape(total // chunk, chunk // each, each, *a.shape[1:]), intervals)
    return chunks, chunk == total and store_every in (None, 1)


def _scan(one_round: Callable[[T, Any], tuple[T, Any]], carry: T, chunks: Any, plain: bool) -> tuple[T, Any]:
    def one_chunk(carry: T, rounds: Any) -> tuple[T, Any]:
        return jax.lax.scan(one_round, carry, rounds)

    if plain:
        return one_chunk(carry, jax.tree.map(lambda a: a[0], chunks))
    return jax.lax.scan(jax.checkpoint(one_chunk), carry, chunks)


def _round_speed(scene: "ThinScene", start: Moving, end: Moving, substeps: int) -> Array:
    """The larger of the speed at the start of a round and the mean speed during it [m/s]. Gradient: none."""
    start, end = jax.lax.stop_gradient((start, end))
    across = cp.scale(jnp.asarray(1.0 / (substeps * scene.dt), start.x[0].dtype), cp.subtract(end.x, start.x))
    return jnp.maximum(relative_speed(scene.mass, start.v), relative_speed(scene.mass, across))


def relative_speed(mass: Array, v: Vec3) -> Array:
    """Largest speed of a vertex relative to the mean velocity [m/s], shape (). Gradient: none."""
    v, mass = jax.lax.stop_gradient((v, mass))
    apart = cp.vector(lambda i: v[i] - jnp.sum(mass * v[i]) / jnp.sum(mass))
    return jnp.sqrt(jnp.max(cp.dot(apart, apart))).astype(v[0].dtype)


def _parts(scene: "ThinScene") -> tuple[SelfContact, ContactElements]:
    assert scene.self_contact is not None and scene.contact_elements is not None
    return scene.self_contact, scene.contact_elements


__all__ = ["AllPairs", "Pairs", "Seen", "close_pairs", "find", "relative_speed", "scan_rounds", "self_forces",
           "watched_pairs"]  # fmt: skip
