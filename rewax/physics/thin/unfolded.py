"""Hinges with their two triangles unfolded into a plane: sizes, and the hinges around each of them."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from rewax.physics.thin.stencils import Topology
from rewax.types import Array


class Hinges(NamedTuple):
    """Sizes of hinges at rest [m], arrays of shape (num_hinges,). The edge points along x, its left is y."""

    length: Array
    left_along: Array
    """x of the left opposite vertex, from the beginning of the edge."""
    left_height: Array
    """Its distance from the edge."""
    right_along: Array
    right_height: Array


class Around(NamedTuple):
    """The triangles and hinges around each hinge and in each triangle; -1 where there is none."""

    sides: np.ndarray
    """Left triangle and number of the edge in it, right triangle and number, shape (num_hinges, 4)."""
    star: np.ndarray
    """The hinge, the two other hinges of its left triangle from the end of its edge on, those of its right triangle
    from its beginning on, shape (num_hinges, 5)."""
    own: np.ndarray
    """The hinges at the three edges of each triangle, from vertex 0 to 1, 1 to 2, 2 to 0, shape (num_triangles, 3)."""


@functools.lru_cache(maxsize=64)
def around(topology: Topology) -> Around:
    """Triangles and hinges that are neighbours."""
    triangles, hinges = topology.triangles.indices, topology.hinges.indices
    owner = {(t[k], t[(k + 1) % 3]): (i, k) for i, t in enumerate(triangles.tolist()) for k in range(3)}
    sides = np.asarray([(*owner[a, b], *owner[b, a]) for a, b, *_ in hinges.tolist()], int).reshape(-1, 4)
    own = np.full((len(triangles), 3), -1)
    for start in (0, 2):
        own[sides[:, start], sides[:, start + 1]] = np.arange(len(hinges))
    others = [own[sides[:, s], (sides[:, s + 1] + k) % 3] for s in (0, 2) for k in (1, 2)]
    return Around(sides, np.stack([np.arange(len(hinges)), *others], axis=-1), own)


def hinge_sizes(topology: Topology, inverse_edges: Array) -> Hinges:
    """Sizes of hinges from the inverse edge matrices of triangles. Gradient: exact."""
    edges = inverse_2x2(inverse_edges)
    flat = jnp.stack([jnp.zeros_like(edges[:, :, 0]), edges[:, :, 0], edges[:, :, 1]], axis=1)
    index, found = around(topology).sides, []
    for t, k, start, end in ((index[:, 0], index[:, 1], 0, 1), (index[:, 2], index[:, 3], 1, 0)):
        p, q, r = (flat[t, (k + j) % 3] for j in (start, end, 2))
        edge, other = q - p, r - p
        length = jnp.sqrt(jnp.sum(edge**2, axis=-1))
        along = jnp.sum(edge * other, axis=-1) / length
        across = jnp.abs(edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0]) / length
        found.append((length, along, across))
    (length, along, across), (_, beside, below) = found
    return Hinges(length, along, across, beside, below)


def inverse_2x2(a: Array) -> Array:
    """Inverse of 2x2 matrices, shape (..., 2, 2)."""
    p, q, r, s = a[..., 0, 0], a[..., 0, 1], a[..., 1, 0], a[..., 1, 1]
    cofactors = jnp.stack([jnp.stack([s, -q], axis=-1), jnp.stack([-r, p], axis=-1)], axis=-2)
    return cofactors / (p * s - q * r)[..., None, None]


def unfolded(sizes: Hinges) -> tuple:
    """The four corners of hinges in the plane z = 0."""
    zero = jnp.zeros_like(sizes.length)
    return (
        (zero, zero, zero),
        (sizes.length, zero, zero),
        (sizes.left_along, sizes.left_height, zero),
        (sizes.right_along, -sizes.right_height, zero),
    )


__all__ = ["Around", "Hinges", "around", "hinge_sizes", "inverse_2x2", "unfolded"]
