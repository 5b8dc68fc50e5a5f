"""Surface nets of known functions: where they lie, which way they face, that they are closed."""

import numpy as np
import pytest

from rewax.viz.surface_nets import surface_nets

CENTER = np.array([0.02, -0.03, 0.01])


def ball(cells):
    """Radius minus the distance from a centre, on a grid of the cube from -1 to 1; its net, in the cube's units."""
    axis = np.linspace(-1.0, 1.0, cells + 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    vertices, normals, triangles = surface_nets(0.6 - np.linalg.norm(points - CENTER, axis=-1), 0.0)
    return vertices * 2.0 / cells - 1.0, normals, triangles


def volume(vertices, triangles):
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    return np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6.0


def test_a_ball_converges_with_the_square_of_the_cells():
    errors = []
    for cells in (12, 24, 48):
        vertices, normals, triangles = ball(cells)
        errors.append(abs(volume(vertices, triangles) / (4.0 / 3.0 * np.pi * 0.6**3) - 1.0))
        outward = (vertices - CENTER) / np.linalg.norm(vertices - CENTER, axis=1, keepdims=True)
        assert np.einsum("ni,ni->n", normals, outward).min() > 0.98
    assert errors[0] < 0.1 and errors[1] < errors[0] / 3.0 and errors[2] < errors[1] / 3.0


def test_every_edge_belongs_to_two_triangles_that_pass_it_in_opposite_directions():
    _, _, triangles = ball(12)
    edges = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    forward, counts = np.unique(edges, axis=0, return_counts=True)
    assert np.all(counts == 1)
    np.testing.assert_array_equal(forward, np.unique(edges[:, ::-1], axis=0))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_vertices_of_a_slab_lie_where_its_faces_cross_the_level(axis):
    values = np.zeros((10, 10, 10))
    inside = np.zeros_like(values)
    inside[2:8, 2:8, 2:8] = 1.0
    values = np.moveaxis(inside, 0, axis) * 4.0
    vertices, _, _ = surface_nets(values, 1.0)  # a quarter of the way from 0 to 4
    interior = np.all((np.delete(vertices, axis, axis=1) > 2.5) & (np.delete(vertices, axis, axis=1) < 6.5), axis=1)
    np.testing.assert_allclose(np.unique(vertices[interior, axis].round(9)), [1.25, 7.75])
