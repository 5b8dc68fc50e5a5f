"""Linear maps from arrays over vertices to the corners of elements and back, each the transpose of the other."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.by_content import ByContent
from rewax.lowering.linear_primitive import Arrays, linear_call
from rewax.types import Array


class Stencil(ByContent):
    """Vertex indices of elements of one kind; hashable, so that it can be a static field.

    Attributes:
      indices: int32 of shape (num_elements, num_corners), read-only.
      num_vertices: length of arrays over vertices.

    Raises:
      ValueError: an index below 0, or not below num_vertices: C++ would read beside the array.
    """

    def __init__(self, indices: np.ndarray, num_vertices: int) -> None:
        self.indices = np.array(indices, np.int32)
        if odd := self.indices[(self.indices < 0) | (self.indices >= num_vertices)].tolist():
            raise ValueError(f"an element has vertex {odd[0]}, but there are {num_vertices}: they count from 0")
        self.indices.setflags(write=False)
        self.num_vertices = num_vertices
        super().__init__(self.indices.tobytes(), self.indices.shape, num_vertices)

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

    def __len__(self) -> int:
        return len(self.indices)

    def __repr__(self) -> str:
        return f"Stencil({len(self)} elements, {self.num_vertices} vertices)"


class Listed(NamedTuple):
    """Elements that a program finds as it runs, in a list of fixed length.

    Attributes:
      corners: vertices of each element, int32 of shape (num_corners, capacity), all from 0 to num_vertices - 1, beyond
        the last element, too: the C++ programs do not check them.
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
    for pieces in _by_component(values, num_corners):
        zeros = jnp.zeros((*pieces.shape[:-1], num_vertices), pieces.dtype)
        out.append(zeros.at[..., where].add(pieces, mode="promise_in_bounds"))
    return tuple(out)


def _by_component(values: Arrays, num_corners: int) -> list[Array]:
    """Of each component its values at all corners, one corner after the other."""
    components = len(values) // num_corners
    return [jnp.concatenate(values[i::components], axis=-1) for i in range(components)]


def gather_listed(listed: Listed, fields: Arrays) -> Arrays:
    """``gather`` for a list of elements. Beyond the last element, values are those at the vertices that are there.

    Gradient: exact for the list's elements, none by way of the entries beyond; its transpose is ``assemble_listed``.
    """
    return linear_call(gather_at, assemble_at, listed.num_vertices, (listed.corners, listed.count), fields)


def assemble_listed(listed: Listed, values: Arrays) -> Arrays:
    """``assemble`` for a list of elements; entries beyond the last one add nothing.

    Gradient: exact where values beyond the last element are zero; its transpose is ``gather_listed``.
    """
    return linear_call(assemble_at, gather_at, listed.num_vertices, (listed.corners, listed.count), values)


def gather_at(num_vertices: int, residuals: Arrays, linear: Arrays) -> Arrays:
    """The rule of ``gather_listed`` for ``linear_call``; residuals: corners and count."""
    del num_vertices
    corners = residuals[0]
    columns = [corners[..., k, :] for k in range(corners.shape[-2])]
    return tuple(jnp.take_along_axis(a, k, axis=-1, mode="promise_in_bounds") for k in columns for a in linear)


def assemble_at(num_vertices: int, residuals: Arrays, linear: Arrays) -> Arrays:
    """The rule of ``assemble_listed`` for ``linear_call``; residuals: corners and count.

    All entries beyond the last element have the same vertices. A GPU would add their zeros one after the other.
    """
    corners, count = residuals
    used = jnp.arange(corners.shape[-1]) < count[..., None]
    where = jnp.where(used[..., None, :], corners, num_vertices).reshape(*corners.shape[:-2], -1)

    def add(index: Array, value: Array) -> Array:
        return jnp.zeros(num_vertices, value.dtype).at[index].add(value, mode="drop")

    for _ in where.shape[:-1]:
        add = jax.vmap(add)
    return tuple(add(where, pieces) for pieces in _by_component(linear, corners.shape[-2]))


__all__ = ["Listed", "Stencil", "assemble", "assemble_at", "assemble_listed", "gather", "gather_at", "gather_listed"]
