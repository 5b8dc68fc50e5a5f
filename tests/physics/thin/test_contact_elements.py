"""Neighbours along the mesh, and trees."""

import numpy as np

from rewax.physics.thin.contact_elements import near_vertices, tree_order


def test_neighbours_are_near_along_the_mesh_and_trees_hold_every_element_once():
    edges = np.asarray([[0, 1], [1, 2], [2, 3]])
    points = np.asarray([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [4.0, 0, 0]])
    near, longer = near_vertices(edges, points, 2.0)
    assert near == [{0, 1, 2}, {0, 1, 2}, {0, 1, 2, 3}, {2, 3}]
    np.testing.assert_array_equal(longer, [4.0, 3.0, np.inf, 3.0])
    order = tree_order(np.random.default_rng(0).random((21, 3)), 16)
    assert len(order) == 32 and sorted(order) == [-1] * 11 + list(range(21))
