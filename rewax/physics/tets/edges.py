"""Linear maps from vertices to the edges of tets and back, each the transpose of the other."""

import functools

import jax.numpy as jnp
import numpy as np

from rewax.lowering.by_content import ByContent
from rewax.lowering.linear_primitive import Arrays, linear_call
from rewax.physics.numerics.components import Mat3, Vec3
from rewax.types import Array


class TetTopology(ByContent):
    """Vertex indices of the tets; hashable, so that it can be a static field.

    Attributes:
      tets: int32 of shape (num_tets, 4), read-only.
      num_vertices: length of arrays over vertices.
    """

    def __init__(self, tets: np.ndarray, num_vertices: int) -> None:
        self.tets = np.array(tets, np.int32)
        self.tets.setflags(write=False)
        self.num_vertices = num_vertices
        super().__init__(self.tets.tobytes(), num_vertices)

    def __repr__(self) -> str:
        return f"TetTopology({len(self.tets)} tets, {self.num_vertices} vertices)"

    @functools.cached_property
    def by_vertex(self) -> np.ndarray:
        """Vertices of all tets: vertex 0 of each tet, then vertex 1 of each, ..., shape (4 num_tets,)."""
        return np.ascontiguousarray(self.tets.T).reshape(-1)


def edges(topology: TetTopology, x: Vec3) -> Mat3:
    """Edge matrix of each tet; its columns are the edges from vertex 0 to vertices 1, 2, 3.

    Args:
      topology: the tets.
      x: a vector for each vertex, components of shape (num_vertices,).

    Returns:
      Components of shape (num_tets,). Gradient: exact; its transpose is ``gather_forces``.
    """
    flat = linear_call(_edges, _assemble, topology, (), x)
    return _as_matrix(flat)


def gather_forces(topology: TetTopology, columns: Mat3) -> Vec3:
    """Sum the columns of tets at vertices: column k goes to vertex k + 1, minus the sum of the columns to vertex 0.

    Args:
      topology: the tets.
      columns: components of shape (num_tets,).

    Returns:
      Components of shape (num_vertices,). Gradient: exact; its transpose is ``edges``.
    """
    flat = linear_call(_assemble, _edges, topology, (), [a for row in columns for a in row])
    return (flat[0], flat[1], flat[2])


def _as_matrix(flat: Arrays) -> Mat3:
    return ((flat[0], flat[1], flat[2]), (flat[3], flat[4], flat[5]), (flat[6], flat[7], flat[8]))


def _edges(topology: TetTopology, residuals: Arrays, linear: Arrays) -> Arrays:
    """For each component (..., vertices) the three differences (..., tets)."""
    del residuals
    out: list[Array] = []
    for a in linear:
        at = [a.at[..., topology.tets[:, k]].get(mode="promise_in_bounds") for k in range(4)]
        out += [at[k] - at[0] for k in (1, 2, 3)]
    return tuple(out)


def _assemble(topology: TetTopology, residuals: Arrays, linear: Arrays) -> Arrays:
    del residuals
    out: list[Array] = []
    for i in range(0, len(linear), 3):
        b, c, d = linear[i : i + 3]
        pieces = jnp.concatenate([-(b + c + d), b, c, d], axis=-1)
        zeros = jnp.zeros((*b.shape[:-1], topology.num_vertices), b.dtype)
        out.append(zeros.at[..., topology.by_vertex].add(pieces, mode="promise_in_bounds"))
    return tuple(out)


__all__ = ["TetTopology", "edges", "gather_forces"]
