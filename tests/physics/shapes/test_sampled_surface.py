"""Surfaces lie where the distance is zero, however fine the grid; those of solids are closed and face outwards."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.shapes import HeightField, SampledDistance, signed_distance
from rewax.physics.shapes.sampled_surface import height_surface, sampled_surface

pytest.importorskip("skimage")
SEMI_AXES = np.array([0.8, 0.5, 0.6])


def egg(num_nodes, half=1.0, scale=1.0):
    """An ellipsoid about (1, 2, 3), whose distance is exact near the surface to first order."""
    axes = [np.linspace(-half, half, n) for n in num_nodes]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    level = np.linalg.norm(nodes / SEMI_AXES, axis=-1) - scale
    return SampledDistance(
        values=jnp.asarray(0.5 * level, jnp.float32),
        origin=jnp.asarray([1.0, 2.0, 3.0]) - half,
        spacing=jnp.asarray(2.0 * half / (num_nodes[0] - 1)),
    )


def surface(shape):
    return sampled_surface(shape.values, shape.origin, shape.spacing)


def volume(vertices, triangles):
    a, b, c = (vertices[triangles[:, i]].astype(float) for i in range(3))
    return np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6.0


def is_closed(triangles):
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)


@pytest.mark.parametrize("num_nodes", [40, 64, 65, 150])
def test_vertices_are_where_the_distance_is_zero(num_nodes):
    shape = egg((num_nodes,) * 3)
    vertices, triangles = surface(shape)
    assert vertices.dtype == np.float32 and len(triangles) < 40_000
    assert np.abs(signed_distance(shape, jnp.asarray(vertices))[0]).max() < 2e-3
    assert is_closed(triangles)
    assert volume(vertices - [1.0, 2.0, 3.0], triangles) == pytest.approx(
        4.0 / 3.0 * np.pi * SEMI_AXES.prod(), rel=0.01
    )


def test_equal_shapes_have_one_surface():
    assert surface(egg((20,) * 3))[0] is surface(egg((20,) * 3))[0]
    assert surface(egg((20,) * 3))[0] is not surface(egg((20,) * 3, scale=0.9))[0]


def test_a_solid_that_fills_its_grid_ends_a_little_beyond_it():
    """Beyond the grid the distance is that at its border and the one to it."""
    shape = egg((21,) * 3, half=0.45)
    vertices, triangles = surface(shape)
    assert is_closed(triangles) and volume(vertices - [1.0, 2.0, 3.0], triangles) > 0.9**3
    assert np.abs(signed_distance(shape, jnp.asarray(vertices))[0]).max() < 0.01
    assert np.abs(vertices - [1.0, 2.0, 3.0]).max() > 0.46


def test_a_grid_without_a_surface_has_none():
    nothing = egg((8,) * 3)
    assert surface(nothing.replace(values=jnp.ones((8, 8, 8)))) is None


@pytest.mark.parametrize("num_nodes", [(2, 3), (9, 5), (130, 70)])
def test_ground_is_drawn_where_its_distance_is_zero_and_faces_up(num_nodes):
    nx, nz = num_nodes
    x, z = np.meshgrid(np.arange(nx), np.arange(nz), indexing="ij")
    heights = jnp.asarray(0.3 * np.sin(0.05 * x) * np.cos(0.04 * z), jnp.float32)
    shape = HeightField(heights=heights, origin=jnp.array([1.0, -2.0]), spacing=0.1)
    vertices, triangles = height_surface(shape.heights, shape.origin, shape.spacing)
    assert (
        height_surface(shape.heights, shape.origin, shape.spacing)[0] is vertices
        and vertices.dtype == np.float32
        and len(triangles) < 10_000
    )
    assert np.abs(signed_distance(shape, jnp.asarray(vertices))[0]).max() < 0.01
    np.testing.assert_allclose(vertices[[0, -1]][:, [0, 2]], [[1.0, -2.0], vertices[:, [0, 2]].max(axis=0)])
    assert (vertices[:, [0, 2]].max(axis=0) > [0.1 * (nx - 1) + 0.99, 0.1 * (nz - 1) - 2.01]).all()
    a, b, c = (vertices[triangles[:, i]].astype(float) for i in range(3))
    area = np.cross(b - a, c - a)[:, 1] / 2.0
    assert (area > 0).all() and area.sum() == pytest.approx(np.ptp(vertices[:, 0]) * np.ptp(vertices[:, 2]), rel=1e-4)


def test_ground_of_traced_numbers_is_left_out():
    jax.jit(lambda heights: [height_surface(heights, jnp.zeros(2), 0.1)] == [None] or 1 / 0)(jnp.zeros((3, 3)))
