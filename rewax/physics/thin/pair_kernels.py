"""Search for close pairs, and the linear maps between vertices and corners of pairs, in C++ on CPUs and JAX elsewhere.

``pairs.cc`` has the loops. Both forms give the same pairs in the same order, up to rounding at the edge of the skin.
"""

import math
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering import build
from rewax.lowering.linear_primitive import Arrays, ByPlatform, linear_call, no_transpose
from rewax.lowering.stencils import Listed, assemble_at, gather_at
from rewax.physics.numerics.components import Vec3
from rewax.physics.thin import broad_phase
from rewax.physics.thin.contact_elements import ContactElements
from rewax.types import Array

SOURCE = build.Source("pairs", build.THREADS.read_text() + Path(__file__).with_name("pairs.cc").read_text())
_TARGETS = ("rewax_find_pairs", "rewax_pairs_to_corners", "rewax_pairs_to_vertices")


class _Query(NamedTuple):
    """Settings of a search; hashable."""

    elements: ContactElements
    with_triangles: bool
    """Pairs of vertices with triangles; else pairs of edges."""
    capacity: int


class CloseElements(NamedTuple):
    """Pairs of elements in a list of fixed length."""

    first: Array
    second: Array
    """Indices, int32 of shape (capacity,); 0 beyond the last pair."""
    count: Array  # pyright: ignore[reportIncompatibleMethodOverride]
    """Number of pairs that are close, shape (), int32; above the capacity, some are missing."""


def find_pairs(
    elements: ContactElements, x: Vec3, lengths: Array, *, with_triangles: bool, capacity: int
) -> CloseElements:
    """Pairs of elements, no neighbours, that are closer than their thickness plus the skin.

    Args:
      elements: what touches.
      x: positions [m], components of shape (num_vertices,).
      lengths: half of the thickness of cloth and of ropes, and the skin [m], shape (3,).
      with_triangles: pairs of a vertex and a triangle; else of two edges.
      capacity: length of the lists.

    Gradient: none.
    """
    at, lengths = jax.lax.stop_gradient((jnp.stack(x), lengths))
    like = [jax.ShapeDtypeStruct(shape, jnp.int32) for shape in ((capacity,), (capacity,), ())]
    query = _Query(elements, with_triangles, capacity)
    return CloseElements(*linear_call(_FIND, no_transpose, query, (at, lengths.astype(at.dtype)), (), like=like))


def to_corners(listed: Listed, fields: tuple[Array, ...]) -> tuple[Array, ...]:
    """Values of fields at the corners of pairs: entry 4 f + k is field f at corner k, shape (num_pairs,).

    Args:
      listed: the pairs, with four corners each.
      fields: arrays of shape (num_vertices,).

    Gradient: exact; its transpose is ``to_vertices``.
    """
    like = [jax.ShapeDtypeStruct(listed.corners.shape[1:], a.dtype) for a in fields for _ in range(4)]
    known = (listed.corners, listed.count)
    return linear_call(_TO_CORNERS, _TO_VERTICES, _Count(listed.num_vertices), known, fields, like=like)


def to_vertices(listed: Listed, values: tuple[Array, ...]) -> tuple[Array, ...]:
    """Sums of values at the vertices: the transpose of ``to_corners``. Gradient: exact.

    Values beyond the last pair must be zero.
    """
    like = [jax.ShapeDtypeStruct((listed.num_vertices,), a.dtype) for a in values[::4]]
    known = (listed.corners, listed.count)
    return linear_call(_TO_VERTICES, _TO_CORNERS, _Count(listed.num_vertices), known, values, like=like)


class _Count(NamedTuple):
    num_vertices: int


# --- C++ --------------------------------------------------------------------------------------------------------------


def is_used() -> bool:
    """Whether programs for CPUs use these kernels, which requires that they could be built."""
    return build.is_usable(SOURCE, _TARGETS, "rewax.physics.thin.pair_kernels")


def _find(query: _Query, residuals: Arrays, linear: Arrays) -> Arrays:
    at, lengths = residuals
    if not is_used():
        return _find_xla(query, residuals, linear)
    elements, capacity = query.elements, query.capacity
    batch = at.shape[:-2]
    kinds = elements.kinds(query.with_triangles)
    tables, sizes = [], []
    for kind in kinds:
        tables += [np.ascontiguousarray(kind.corners.T), kind.is_rope.astype(np.int32), kind.order]
        sizes += [kind.corners.shape[1], len(kind.corners), len(kind.order)]
    near = elements.neighbours(query.with_triangles)
    tables.insert(3, near)
    head = (math.prod(batch), not query.with_triangles, elements.levels, capacity, at.shape[-1])
    shapes = [jax.ShapeDtypeStruct((*batch, *own), jnp.int32) for own in ((capacity,), (capacity,), ())]
    run = jax.ffi.ffi_call("rewax_find_pairs", shapes)
    sizes = np.asarray((*head, *sizes, near.shape[1]), np.int64)
    return tuple(run(at, lengths, *map(jnp.asarray, tables), sizes=sizes))


def _find_xla(query: _Query, residuals: Arrays, linear: Arrays) -> Arrays:
    del linear

    def search(at: Array, lengths: Array) -> Arrays:
        return broad_phase.find_pairs(query.elements, at, lengths, query.with_triangles, query.capacity)

    for _ in residuals[0].shape[:-2]:
        search = jax.vmap(search)
    return search(*residuals)


def _corners_cpp(static: _Count, residuals: Arrays, fields: Arrays) -> Arrays:
    corners = residuals[0]
    if not is_used():
        return _corners_xla(static, residuals, fields)
    return _mapped("rewax_pairs_to_corners", static, corners, fields, len(fields), 4 * len(fields), corners.shape[-1])


def _vertices_cpp(static: _Count, residuals: Arrays, values: Arrays) -> Arrays:
    corners = residuals[0]
    if not is_used():
        return _vertices_xla(static, residuals, values)
    count = len(values) // 4
    return _mapped("rewax_pairs_to_vertices", static, corners, values, count, count, static.num_vertices)


def _mapped(
    target: str, static: _Count, corners: Array, arrays: Arrays, fields: int, results: int, length: int
) -> Arrays:
    batch = corners.shape[:-2]
    shapes = [jax.ShapeDtypeStruct((*batch, length), arrays[0].dtype)] * results
    sizes = np.asarray((math.prod(batch), fields, static.num_vertices, corners.shape[-1]), np.int64)
    return tuple(jax.ffi.ffi_call(target, shapes)(corners, *arrays, sizes=sizes))


# --- JAX --------------------------------------------------------------------------------------------------------------


def _corners_xla(static: _Count, residuals: Arrays, fields: Arrays) -> Arrays:
    flat = gather_at(static.num_vertices, residuals, fields)
    return tuple(flat[len(fields) * k + f] for f in range(len(fields)) for k in range(4))


def _vertices_xla(static: _Count, residuals: Arrays, values: Arrays) -> Arrays:
    flat = tuple(values[4 * f + k] for k in range(4) for f in range(len(values) // 4))
    return assemble_at(static.num_vertices, residuals, flat)


_FIND = ByPlatform(_find, _find_xla)
_TO_CORNERS = ByPlatform(_corners_cpp, _corners_xla)
_TO_VERTICES = ByPlatform(_vertices_cpp, _vertices_xla)

__all__ = ["SOURCE", "CloseElements", "find_pairs", "is_used", "to_corners", "to_vertices"]
