"""Linear maps from vertices to the corners of elements and back, each the transpose of the other."""

from typing import NamedTuple

from rewax.lowering import stencils
from rewax.lowering.linear_primitive import Arrays
from rewax.lowering.stencils import Stencil
from rewax.physics.numerics.components import Vec3
from rewax.types import Array


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
    flat = stencils.gather(stencil, x)
    return tuple((flat[i], flat[i + 1], flat[i + 2]) for i in range(0, len(flat), 3))


def scatter(stencil: Stencil, values: tuple[Vec3, ...]) -> Vec3:
    """Sum the vectors at the corners of elements at the vertices; components of shape (num_vertices,).

    Gradient: exact; its transpose is ``corners``.
    """
    flat = stencils.assemble(stencil, tuple(a for corner in values for a in corner))
    return (flat[0], flat[1], flat[2])


def gather(stencil: Stencil, a: Array) -> Arrays:
    """The numbers at the corners of each element, as ``corners`` for vectors. Gradient: exact."""
    return stencils.gather(stencil, (a,))


def sum_corners(stencil: Stencil, values: Arrays) -> Array:
    """Sum numbers at the corners of elements, as ``scatter`` for vectors. Gradient: exact."""
    return stencils.assemble(stencil, values)[0]


__all__ = ["Stencil", "Topology", "corners", "gather", "scatter", "sum_corners"]
