"""Hinges unfolded into a plane, and the hinges around them."""

import numpy as np
from thin_bodies import SHEET, cloth_scene

from rewax.physics.thin.unfolded import around, hinge_sizes, inverse_2x2


def test_sizes_of_hinges_are_those_of_the_mesh(x64):
    scene = cloth_scene()
    sizes = hinge_sizes(scene.topology, scene.rest.inverse_edges)
    a, b, c, _ = np.moveaxis(SHEET.vertices[scene.topology.hinges.indices], 1, 0)
    length = np.linalg.norm(b - a, axis=1)
    np.testing.assert_allclose(sizes.length, length)
    np.testing.assert_allclose(sizes.left_along, np.sum((b - a) * (c - a), axis=1) / length, atol=1e-12)
    area = 0.5 * length * (np.asarray(sizes.left_height) + np.asarray(sizes.right_height))
    np.testing.assert_allclose(area, 0.1 * 0.1)  # two half cells


def test_hinges_around_a_hinge_share_its_triangles():
    topology = cloth_scene().topology
    sides, star, own = around(topology)
    for hinge, (left, _, right, _) in enumerate(sides):
        assert set(star[hinge]) == set(own[left]) | set(own[right])
    assert (own < 0).sum() == 2 * (4 + 3)  # edges of the rim


def test_the_inverse_of_small_matrices(x64):
    a = np.random.default_rng(0).standard_normal((5, 2, 2))
    np.testing.assert_allclose(inverse_2x2(a) @ a, np.broadcast_to(np.eye(2), a.shape), atol=1e-12)
