"""Surfaces of particles: where a smoothed density falls to half, one surface for each material.

The player computes the same surfaces in the browser (``player_surface.js``).
"""

from typing import NamedTuple

import numpy as np

from rewax.viz.recording import Recording, diameters
from rewax.viz.surface_nets import surface_nets

CELLS_PER_DIAMETER = 2.0
"""Cells of the density's grid along a particle's diameter."""
SMOOTHING = 1.0
"""Standard deviation of the Gaussian around a particle, in diameters."""
LEVEL = 0.5
"""Density on the surface; 1 is the median over the particles, thus that of the interior."""
MARGIN = 4
"""Cells between the particles and the end of the grid, so that every surface is closed."""
_MAX_CELLS = 2_000_000
"""Cells of the largest grid, about: margins add some. Where splashes fly far, cells become longer instead."""


class Surface(NamedTuple):
    """A closed surface.

    Attributes:
      vertices: [m], shape (num_vertices, 3).
      normals: outward, of unit length, shape (num_vertices, 3).
      triangles: counter-clockwise seen from outside, shape (num_triangles, 3).
      nearest: index of the particle nearest to each vertex, shape (num_vertices,).
      loose: indices of the particles that fly alone, outside the surface, shape (num_loose,).
    """

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    nearest: np.ndarray
    loose: np.ndarray


def has_surfaces(recording: Recording) -> bool:
    """Whether the recording has particles that are not vertices of a mesh: a mesh has a surface already."""
    return recording.particles is not None and recording.triangles is None


def surfaces(recording: Recording, frame: int, *, sizes: np.ndarray | None = None) -> list[Surface]:
    """The surface of each material's particles in a frame, in the order of the materials; absent materials have none.

    Each particle adds a Gaussian to a density on a grid. The surface lies where the density is half of the median over
    the particles. Particles outside it, further than a diameter away, are loose.

    Args:
      recording: has particles, not vertices of a mesh.
      frame: whose surfaces are computed.
      sizes: ``diameters(recording)``, shape (num_particles,); None computes them, in each call anew.
    """
    assert recording.particles is not None
    cloud = np.asarray(recording.particles[frame], np.float64)
    sizes = diameters(recording) if sizes is None else sizes
    materials = np.zeros(len(cloud), int) if recording.materials is None else np.asarray(recording.materials)
    members = [np.flatnonzero(materials == material) for material in np.unique(materials)]
    return [_surface(cloud, some, float(sizes[some].mean())) for some in members]


def _surface(cloud: np.ndarray, members: np.ndarray, diameter: float) -> Surface:
    from scipy.ndimage import gaussian_filter
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    points = cloud[members]
    extent = np.ptp(points, axis=0)
    cell = max(diameter / CELLS_PER_DIAMETER, float(np.prod(extent + diameter) / _MAX_CELLS) ** (1 / 3))
    low = points.min(axis=0) - MARGIN * cell
    place = (points - low) / cell
    density = _counts(place, np.ceil(extent / cell).astype(int) + 2 * MARGIN + 1)
    density = gaussian_filter(density, SMOOTHING * diameter / cell, mode="constant", truncate=3.0)
    for axis in range(3):  # a closed surface even where many particles share a place
        np.moveaxis(density, axis, 0)[[0, 1, -2, -1]] = 0.0
    at_particles = density[tuple(np.rint(place).astype(int).T)]
    level = LEVEL * float(np.median(at_particles))
    vertices, normals, triangles = surface_nets(density, level)
    vertices = low + cell * vertices
    nearest = members[cKDTree(points).query(vertices)[1]]
    away = cKDTree(vertices).query(points)[0] > diameter
    return Surface(vertices, normals, triangles, nearest, members[(at_particles < level) & away])


def _counts(place: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Number of particles at each node of a grid; a particle is shared among the eight corners of its cell."""
    base, part = np.floor(place).astype(int), place - np.floor(place)
    counts = np.zeros(int(np.prod(shape)))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, part, 1.0 - part), axis=1)
        flat = np.ravel_multi_index(tuple((base + corner).T), tuple(shape))
        counts += np.bincount(flat, weights=weight, minlength=len(counts))
    return counts.reshape(tuple(shape))


__all__ = ["CELLS_PER_DIAMETER", "LEVEL", "MARGIN", "SMOOTHING", "Surface", "has_surfaces", "surfaces"]
