"""Terrain: planes, which bilinear heights reproduce, and beyond the grid."""

import numpy as np
from shape_cases import NUM, TERRAIN, evaluate


def test_height_of_a_slope_is_the_distance_to_its_plane(x64):
    """Within the field exact, beyond it level; halfway along an edge of a cell the mean of its ends."""
    x, z = np.indices((5, 4)) * 0.4 + np.array([-0.8, -0.5])[:, None, None]
    slope = TERRAIN.replace(heights=0.1 + 0.3 * x - 0.4 * z)
    p = np.random.default_rng(9).uniform([-0.8, -1, -0.5], [0.8, 1, 0.7], (NUM, 3))
    distance, normal = evaluate(slope, p)
    np.testing.assert_allclose(distance, (p @ [-0.3, 1.0, 0.4] - 0.1) / np.sqrt(1.25), atol=1e-13)
    np.testing.assert_allclose(
        normal, np.broadcast_to(np.array([-0.3, 1.0, 0.4]) / np.sqrt(1.25), (NUM, 3)), atol=1e-12
    )
    p[:] = [9.0, 0.0, 9.0]
    p[0] = [-0.6, 0.0, -0.5]
    distance, normal = evaluate(TERRAIN, p)
    np.testing.assert_allclose(distance[0] / normal[0, 1], -TERRAIN.heights[:2, 0].mean(), rtol=1e-12)
    np.testing.assert_allclose(distance[1:], -TERRAIN.heights[-1, -1], rtol=1e-12)
    np.testing.assert_allclose(normal[1:], np.broadcast_to([0.0, 1.0, 0.0], (NUM - 1, 3)), atol=1e-14)
