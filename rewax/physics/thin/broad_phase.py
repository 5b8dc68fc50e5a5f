"""Close pairs of elements, by trees of boxes of fixed form.

Neighbours in the mesh stay neighbours in space, because cloth and ropes hardly stretch. So the trees are built once, on
the rest shape; a search computes the boxes anew and descends level by level through pairs of boxes that overlap. Each
level keeps a list of fixed length. ``Found.excess`` says by how much the fullest list overflowed.

Gradient: none; which pairs are close is a constant.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from rewax.physics.numerics import components as cp
from rewax.physics.numerics.components import Vec3
from rewax.physics.thin import closest
from rewax.physics.thin.contact_elements import ContactElements, Kind
from rewax.types import Array

_ARITY = 4
BOXES_PER_NODE = 16
"""Overlapping boxes of a level for each of its nodes, for which the lists have room on average."""
WIDER = 4
"""Pairs of overlapping boxes for each close pair, for which the search has room."""


class Boxes(NamedTuple):
    """Lower and upper corners of boxes [m], arrays (3, num_boxes)."""

    lower: Array
    upper: Array


class Found(NamedTuple):
    """Pairs in a list of fixed length."""

    first: Array
    second: Array
    """Indices of elements, int32 of shape (capacity,); 0 beyond the last pair."""
    valid: Array
    """Whether an entry is a pair, shape (capacity,)."""
    excess: Array
    """Pairs that the fullest list had no room for, shape (), int32; 0 or less: none."""


def boxes_of(x: Array, corners: np.ndarray, reach: Array) -> Boxes:
    """Boxes around elements, larger by ``reach`` [m] on every side.

    Args:
      x: positions [m], shape (3, num_vertices).
      corners: vertices of each element, shape (num_elements, num_corners).
      reach: [m], shape () or (num_elements,).
    """
    at = x[:, corners]
    return Boxes(jnp.min(at, axis=-1) - reach, jnp.max(at, axis=-1) + reach)


def overlapping(first: Boxes, second: Boxes | None, orders: tuple, levels: int, capacity: int) -> Found:
    """Pairs of elements whose boxes overlap.

    Args:
      first, second: boxes of all elements of two kinds; second None: pairs within the first, each once.
      orders: for both kinds, their order along the tree, see ``contact_elements.tree_order``.
      levels: number of levels of the trees below their roots.
      capacity: length of the list of pairs.
    """
    same = second is None
    a = box_levels(first, orders[0], levels)
    b = a if second is None else box_levels(second, orders[1], levels)
    i, j = (k.reshape(-1) for k in np.indices((a[-1].lower.shape[1], b[-1].lower.shape[1])))
    if same:
        i, j = i[i <= j], j[i <= j]
    valid: Any = True
    i, j, excess = jnp.asarray(i), jnp.asarray(j), jnp.int32(-(2**30))
    child_i, child_j = (k.reshape(-1) for k in np.indices((_ARITY, _ARITY)))
    for level in reversed(range(levels + 1)):
        overlap = _overlap(a[level], b[level], i, j) & valid
        if same:
            overlap &= i < j if level == 0 else i <= j
        room = min(
            i.size, capacity if level == 0 else BOXES_PER_NODE * max(a[level].lower.shape[1], b[level].lower.shape[1])
        )
        where, valid, count = first_true(overlap, room)
        i, j, excess = i[where], j[where], jnp.maximum(excess, count - room)
        if level:
            i = (_ARITY * i[:, None] + child_i).reshape(-1)
            j = (_ARITY * j[:, None] + child_j).reshape(-1)
            valid = jnp.repeat(valid, _ARITY * _ARITY)
    ids = (jnp.asarray(np.maximum(order, 0)) for order in (orders[0], orders[0] if same else orders[1]))
    first_id, second_id = (jnp.where(valid, order[k], 0) for order, k in zip(ids, (i, j), strict=True))
    return Found(first_id, second_id, valid, excess)


def find_pairs(
    elements: ContactElements, at: Array, lengths: Array, with_triangles: bool, capacity: int
) -> tuple[Array, Array, Array]:
    """``pair_kernels.find_pairs``, for positions of shape (3, num_vertices)."""
    first, second = elements.kinds(with_triangles)

    def halves(kind: Kind) -> Array:
        return jnp.where(kind.is_rope, lengths[1], lengths[0])

    boxes = [boxes_of(at, kind.corners, halves(kind) + 0.5 * lengths[2]) for kind in (first, second)]
    orders = (first.order, second.order)
    found = overlapping(boxes[0], boxes[1] if with_triangles else None, orders, elements.levels, WIDER * capacity)
    near = jnp.bool_(False)
    for column in elements.neighbours(with_triangles).T:
        near = near | (jnp.asarray(column)[found.first] == found.second)
    corners = (*gather_corners(at, first, found.first), *gather_corners(at, second, found.second))
    weights = closest.vertex_triangle(corners) if with_triangles else closest.segments(corners, _smoothing(corners))
    gap = cp.norm(closest.weighted(weights, corners))
    reach = halves(first)[found.first] + halves(second)[found.second] + lengths[2]
    keep = found.valid & ~near & (gap < reach)
    room = min(capacity, keep.size)
    where, valid, count = first_true(keep, room)
    pad = (0, capacity - room)
    i, j = (jnp.pad(jnp.where(valid, k[where], 0), pad) for k in (found.first, found.second))
    return i, j, jnp.where(found.excess > 0, capacity + found.excess, count)


def gather_corners(at: Array, kind: Kind, ids: Array) -> tuple[Vec3, ...]:
    """Corners of elements, from positions of shape (3, num_vertices)."""
    return tuple(cp.vector(lambda i, c=c: at[i, jnp.asarray(c)[ids]]) for c in kind.corners.T)


def _smoothing(corners: tuple[Vec3, ...]) -> Array:
    return 1e-3 * cp.norm(cp.subtract(corners[1], corners[0]))


def first_true(mask: Array, size: int) -> tuple[Array, Array, Array]:
    """Indices of the first ``size`` true entries (0 beyond the last), which of them exist, and how many are true."""
    total = jnp.cumsum(mask, dtype=jnp.int32)
    places = jnp.where(mask, total - 1, size)
    where = jnp.zeros(size, jnp.int32).at[places].set(jnp.arange(mask.size, dtype=jnp.int32), mode="drop")
    return where, jnp.arange(size) < total[-1], total[-1]


def box_levels(boxes: Boxes, order: np.ndarray, levels: int) -> list[Boxes]:
    """Boxes of all levels, the elements first; places without an element have an empty box."""
    there = order >= 0
    lower = jnp.where(there, boxes.lower[:, np.maximum(order, 0)], jnp.inf)
    upper = jnp.where(there, boxes.upper[:, np.maximum(order, 0)], -jnp.inf)
    found = [Boxes(lower, upper)]
    for _ in range(levels):
        lower, upper = found[-1]
        lower, upper = (a.reshape(3, -1, _ARITY) for a in (lower, upper))
        found.append(Boxes(jnp.min(lower, axis=-1), jnp.max(upper, axis=-1)))
    return found


def _overlap(a: Boxes, b: Boxes, i: Array, j: Array) -> Array:
    pairs = [(a.lower[k][i] <= b.upper[k][j]) & (b.lower[k][j] <= a.upper[k][i]) for k in range(3)]
    return pairs[0] & pairs[1] & pairs[2]


__all__ = ["Boxes", "Found", "box_levels", "boxes_of", "find_pairs", "first_true", "gather_corners", "overlapping"]
