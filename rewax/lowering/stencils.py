"""Linear maps from arrays over vertices to the corners of elements and back, each the transpose of the other."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from rewax.lowering.linear_primitive import Arrays, linear_call
from rewax.types import Array


class Stencil:
    """Vertex indices of elements of one kind; hashable, so that it can be a static field.

    Attributes:
      indices: int32 of shape (num_elements, num_corners), read-only.
      num_vertices: length of arrays over vertices.
    """

    def __init__(self, indices: np.ndarray, num_vertices: int) -> None:
        self.indices = np.array(indices, np.int32)
        self.indices.setflags(write=False)
        self.num_vertices = num_vertices
        self._key = (self.indices.tobytes(), self.indices.shape, num_vertices)
        self._hash = hash(self._key)

    @functools.cached_property
    def entries(self) -> tuple[np.ndarray, np.ndarray]:
        """For each vertex its corners of elements, by corner and then by element.

        Returns:
          Where the list of each vertex begins, int32 of shape (num_vertices + 1,), and the lists: num_elements times
          the corner plus the element, int32.
        """
        flat = np.ascontiguousarray(self.indices.T).reshape(-1)
        counts = np.bincount(flat, minlength=self.num_vertices)
        starts = np.concatenate([[0], np.cumsum(counts)])
        return starts.astype(np.int32), np.argsort(flat, kind="stable").astype(np.int32)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Stencil) and self._hash == other._hash and self._key == other._key)

    def __len__(self) -> int:
        return len(self.indices)

    def __repr__(self) -> str:
        return f"Stencil({len(self)} elements, {self.num_vertices} vertices)"


class Listed(NamedTuple):
    """Elements that a program finds as it runs, in a list of fixed length.

    Attributes:
      corners: vertices of each element, int32 of shape (num_corners, capacity).
      count: number of elements, int32 of shape (); at or above the capacity, all entries are elements.
      num_vertices: length of arrays over vertices.
    """

    corners: Array
    count: Array  # pyright: ignore[reportIncompatibleMethodOverride]
    num_vertices: int


def gather(stencil: Stencil, fields: Arrays) -> Arrays:
    """The numbers at the corners of each element: entry num_fields k + f is field f at corner k.

    Gradient: exact; its transpose is ``assemble``.
    """
    return linear_call(_gather, _assemble, stencil, (), fields)


def assemble(stencil: Stencil, values: Arrays) -> Arrays:
    """Sums of numbers at the corners of elements at the vertices. Gradient: exact; its transpose is ``gather``."""
    return linear_call(_assemble, _gather, stencil, (), values)


def _gather(stencil: Stencil, residuals: Arrays, linear: Arrays) -> Arrays:
    del residuals
    columns = stencil.indices.T
    return tuple(a.at[..., column].get(mode="promise_in_bounds") for column in columns for a in linear)


def _assemble(stencil: Stencil, residuals: Arrays, linear: Arrays) -> Arrays:
    del residuals
    where = np.ascontiguousarray(stencil.indices.T).reshape(-1)
    return _summed(jnp.asarray(where), stencil.num_vertices, stencil.indices.shape[1], linear)


def _summed(where: Array, num_vertices: int, num_corners: int, values: Arrays) -> Arrays:
    out: list[Array] = []
    components = len(values) // num_corners
    for i in range(components):
        pieces = jnp.concatenate(values[i::components], axis=-1)
        zeros = jnp.zeros((*pieces.shape[:-1], num_vertices), pieces.dtype)
        out.append(zeros.at[..., where].add(pieces, mode="promise_in_bounds"))
    return tuple(out)


def gather_listed(listed: Listed, fields: Arrays) -> Arrays:
    """``gather`` for a list of elements."""
    return tuple(a.at[column].get(mode="promise_in_bounds") for column in listed.corners for a in fields)


def assemble_listed(listed: Listed, values: Arrays) -> Arrays:
    """``assemble`` for a list of elements."""
    return _summed(listed.corners.reshape(-1), listed.num_vertices, len(listed.corners), values)


__all__ = ["Listed", "Stencil", "assemble", "assemble_listed", "gather", "gather_listed"]
