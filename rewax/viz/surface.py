"""Surfaces of particles: marching cubes over a smoothed density, one surface for each material."""

from typing import NamedTuple

import numpy as np

from rewax.viz.recording import Recording, diameters

_CELLS_PER_DIAMETER = 2.5
"""Cells of the density's grid along a particle's diameter."""
_SMOOTHING = 0.75
"""Standard deviation of the Gaussian that spreads a particle, in diameters."""
_LEVEL = 0.5
"""Of the density where the surface lies; 1 is that in the interior of material at rest."""
_MARGIN = 4
"""Cells around the particles, so that every surface is closed."""
_MAX_CELLS = 2_000_000
"""Of one grid. Far splashes make cells longer rather than the picture slow."""


class Surface(NamedTuple):
    """A closed surface.

    Attributes:
      vertices: [m], shape (num_vertices, 3).
      normals: outward, of unit length, shape (num_vertices, 3).
      triangles: shape (num_triangles, 3).
      nearest: index of the particle nearest to each vertex, shape (num_vertices,).
      loose: indices of particles outside it, which fly alone, shape (num_loose,).
    """

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    nearest: np.ndarray
    loose: np.ndarray


def has_surfaces(recording: Recording) -> bool:
    """Whether a recording shows particles, and not the vertices of a mesh, which have a surface already."""
    return recording.particles is not None and recording.triangles is None


def need_marching_cubes() -> None:
    """Check that the packages are there.

    Raises:
      ValueError: scikit-image is not installed.
    """
    try:
        import scipy.spatial  # noqa: F401
        import skimage.measure  # noqa: F401
    except ImportError:
        raise ValueError("surfaces need scikit-image: pip install 'rewax[surfaces]'") from None


def surfaces(recording: Recording, frame: int) -> list[Surface]:
    """The surface of each material's particles in a frame; none for a material without particles.

    A particle is spread by a Gaussian over the nodes of a grid. The surface (Lorensen and Cline 1987) lies where the
    density is half that of the interior. Particles outside, further than a diameter from it, are loose.

    Raises:
      ValueError: scikit-image is not installed.
    """
    need_marching_cubes()
    assert recording.particles is not None
    cloud, sizes = np.asarray(recording.particles[frame], np.float64), diameters(recording)
    materials = np.zeros(len(cloud), int) if recording.materials is None else np.asarray(recording.materials)
    members = [np.flatnonzero(materials == material) for material in np.unique(materials)]
    return [_surface(cloud, some, float(sizes[some].mean())) for some in members]


def _surface(cloud: np.ndarray, members: np.ndarray, diameter: float) -> Surface:
    from scipy.ndimage import gaussian_filter
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]
    from skimage.measure import marching_cubes

    points = cloud[members]
    extent = np.ptp(points, axis=0)
    cell = max(diameter / _CELLS_PER_DIAMETER, float(np.prod(extent + diameter) / _MAX_CELLS) ** (1 / 3))
    low = points.min(axis=0) - _MARGIN * cell
    where = (points - low) / cell
    density = _spread(where, np.ceil(extent / cell).astype(int) + 2 * _MARGIN + 1)
    density = gaussian_filter(density, _SMOOTHING * diameter / cell, mode="constant", truncate=3.0)
    at_particles = density[tuple(np.rint(where).astype(int).T)]
    level = _LEVEL * float(np.median(at_particles))
    vertices, triangles, normals, _ = marching_cubes(density, level, spacing=(cell,) * 3, gradient_direction="descent")
    vertices = vertices + low
    nearest = members[cKDTree(points).query(vertices)[1]]
    away = cKDTree(vertices).query(points)[0] > diameter
    # scikit-image lists corners clockwise seen from outside.
    return Surface(vertices, normals, triangles[:, ::-1], nearest, members[(at_particles < level) & away])


def _spread(where: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """How many particles the nodes of a grid hold, each shared among the eight corners of its cell."""
    base, part = np.floor(where).astype(int), where - np.floor(where)
    density = np.zeros(tuple(shape))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, part, 1.0 - part), axis=1)
        np.add.at(density, tuple((base + corner).T), weight)
    return density


__all__ = ["Surface", "has_surfaces", "need_marching_cubes", "surfaces"]
