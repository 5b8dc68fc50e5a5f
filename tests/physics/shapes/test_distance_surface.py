"""Surfaces of shapes that do not draw themselves: on the surface, closed, made once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_shapes import Torus, Union

from rewax.physics.shapes import Box, Cone, Sphere, signed_distance
from rewax.physics.shapes.distance_surface import distance_surface

pytest.importorskip("skimage")
SHAPES = [
    Torus(ring=0.3, tube=0.1),
    Union(first=Sphere(radius=0.2), second=Box(half_size=(0.3, 0.1, 0.1))),
    Cone(radius=0.3, half_length=0.5),
]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_vertices_lie_on_the_surface_and_triangles_enclose_the_volume(shape):
    vertices, triangles = distance_surface(shape)
    d, n = signed_distance(shape, jnp.asarray(vertices))
    assert np.abs(d).max() < 0.02  # edges and tips are cut by less than a cell
    a, b, c = (vertices[triangles[:, i]].astype(float) for i in range(3))
    area = np.cross(b - a, c - a)
    assert np.mean(np.sum(area * np.asarray(n)[triangles[:, 0]], axis=1) > 0) > 0.95
    np.testing.assert_allclose(np.einsum("ni,ni->", a, area) / 6.0, shape.volume(), rtol=0.02)
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)


def test_surfaces_are_made_once_for_equal_sizes_also_while_a_program_is_traced():
    torus, kept = Torus(ring=0.3, tube=0.05), []
    jax.jit(lambda x: kept.append(distance_surface(torus)) or x)(0.0)
    assert isinstance(kept[0][0], np.ndarray) and distance_surface(Torus(ring=0.3, tube=0.05))[0] is kept[0][0]
    assert distance_surface(Torus(ring=0.3, tube=0.06))[0] is not kept[0][0]
    jax.eval_shape(lambda torus: kept.append(distance_surface(torus)), torus)  # its sizes are traced
    assert kept[1] is None


def test_an_empty_shape_has_no_surface():
    assert distance_surface(Torus(ring=0.3, tube=-0.01)) is None
