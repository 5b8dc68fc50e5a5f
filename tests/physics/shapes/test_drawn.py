"""Drawings of shapes in their own frames are legal, and as large as the shapes."""

import numpy as np
import pytest
from own_shapes import Torus
from solids import FURTHER, SHAPES

from rewax.physics.shapes import HeightField, Plane, bounding_box
from rewax.physics.shapes.drawn import mesh
from rewax.viz.shapes import bounds, check_drawing

pytest.importorskip("skimage")
BOUNDED = SHAPES | FURTHER | {"torus": Torus(ring=0.3, tube=0.1)}


@pytest.mark.parametrize("name", BOUNDED)
def test_drawings_fill_the_bounding_box(x64, name):
    drawings = BOUNDED[name].draw()
    for drawing in drawings:
        check_drawing(drawing)
    off = 0.05 if name == "baked" else 0.01  # its box ends at a node of its grid
    np.testing.assert_allclose(bounds(drawings), bounding_box(BOUNDED[name]), atol=off)


def test_ground_is_drawn_over_its_grid_and_a_plane_not_at_all():
    heights = np.array([[0.0, 0.1, 0.2], [0.3, 0.4, 0.5]])
    low, high = bounds(HeightField(heights=heights, origin=(1.0, -1.0), spacing=0.5).draw())
    np.testing.assert_allclose([low, high], [[1.0, 0.0, -1.0], [1.5, 0.5, 0.0]], atol=1e-6)
    assert Plane().draw() == [] and mesh(None) == []
