"""Linear maps from vertices to the corners of elements and back, each the transpose of the other."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from rewax.lowering.linear_primitive import Arrays, linear_call
from rewax.physics.numerics.components import Vec3
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

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Stencil) and self._hash == other._hash and self._key == other._key)

    def __len__(self) -> int:
        return len(self.indices)

    def __repr__(self) -> str:
        return f"Stencil({len(self)} elements, {self.num_vertices} vertices)"


class Topology(NamedTuple):
    """The elements of a mesh and its held vertices; hashable."""

    triangles: Stencil
    hinges: Stencil
    """Ends of an inner edge, then the opposite vertices of the triangles on its left and right."""
    segments: Stencil
    bends: Stencil
    """Three consecutive vertices of a rope."""
    held: Stencil


def corners(stencil: Stencil, x: Vec3) -> tuple[Vec3, ...]:
    """The vectors at the corners of each element.

    Args:
      stencil: the elements.
      x: a vector for each vertex, components of shape (num_vertices,).

    Returns:
      For each corner, components of shape (num_elements,). Gradient: exact; its transpose is ``scatter``.
    """
    flat = linear_call(_gather, _assemble, stencil, (), x)
    return tuple((flat[i], flat[i + 1], flat[i + 2]) for i in range(0, len(flat), 3))


def scatter(stencil: Stencil, values: tuple[Vec3, ...]) -> Vec3:
    """Sum the vectors at the corners of elements at the vertices; components of shape (num_vertices,).

    Gradient: exact; its transpose is ``corners``.
    """
    flat = linear_call(_assemble, _gather, stencil, (), [a for corner in values for a in corner])
    return (flat[0], flat[1], flat[2])


def gather(stencil: Stencil, a: Array) -> Arrays:
    """The numbers at the corners of each element, as ``corners`` for vectors. Gradient: exact."""
    return linear_call(_gather, _assemble, stencil, (), (a,))


def sum_corners(stencil: Stencil, values: Arrays) -> Array:
    """Sum numbers at the corners of elements, as ``scatter`` for vectors. Gradient: exact."""
    return linear_call(_assemble, _gather, stencil, (), values)[0]


def _gather(stencil: Stencil, residuals: Arrays, linear: Arrays) -> Arrays:
    del residuals
    columns = stencil.indices.T
    return tuple(a.at[..., column].get(mode="promise_in_bounds") for column in columns for a in linear)


def _assemble(stencil: Stencil, residuals: Arrays, linear: Arrays) -> Arrays:
    del residuals
    where = np.ascontiguousarray(stencil.indices.T).reshape(-1)
    out: list[Array] = []
    components = len(linear) // stencil.indices.shape[1]
    for i in range(components):
        pieces = jnp.concatenate(linear[i::components], axis=-1)
        zeros = jnp.zeros((*pieces.shape[:-1], stencil.num_vertices), pieces.dtype)
        out.append(zeros.at[..., where].add(pieces, mode="promise_in_bounds"))
    return tuple(out)


__all__ = ["Stencil", "Topology", "corners", "gather", "scatter", "sum_corners"]
