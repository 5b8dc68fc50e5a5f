"""Distances to triangles and winding numbers on grids: against brute force, and known solids."""

import numpy as np
import pytest
import trimesh

from rewax.physics.shapes.mesh_distance import distance_on_grid, winding_on_grid


def test_distance_of_random_triangles_is_the_nearest_of_all():
    """Against densely sampled triangles: never nearer, never farther than their pitch."""
    rng = np.random.default_rng(2)
    triangles = rng.uniform(-1, 1, (7, 3, 3))
    axes = [np.linspace(-1.2, 1.2, 7)] * 3
    a, b = np.meshgrid(np.linspace(0, 1, 60), np.linspace(0, 1, 60))
    weights = np.stack([a, b, 1 - a - b])[:, a + b <= 1 + 1e-9]
    dense = np.einsum("ws,fwc->fsc", weights, triangles).reshape(-1, 3)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    brute = np.linalg.norm(points[..., None, :] - dense, axis=-1).min(axis=-1)
    got = distance_on_grid(triangles, axes)
    assert np.all(got <= brute + 1e-12) and np.all(got >= brute - 0.03)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_winding_counts_overlaps_and_cavities(axis):
    """A block with a cavity in which there is a block: 1, 0, 1; where two blocks overlap: 2."""

    def block(half, at=(0.0, 0.0, 0.0), sign=1):
        box = trimesh.creation.box(2 * np.array([half] * 3)).apply_translation(at)
        return np.asarray(box.triangles)[:, ::sign]

    axes = [np.linspace(-1.5, 1.5, 13)] * 3
    x = np.abs(np.stack(np.meshgrid(*axes, indexing="ij"))).max(axis=0)
    onion = np.concatenate([block(1.1), block(0.7, sign=-1), block(0.3)])
    np.testing.assert_array_equal(winding_on_grid(onion, axes, axis), (x < 1.1) * 1 - (x < 0.7) * 1 + (x < 0.3) * 1)
    both = winding_on_grid(np.concatenate([block(0.6), block(0.6, (0.3, 0.3, 0.3))]), axes, axis)
    assert both[6, 6, 6] == 2 and both[4, 4, 4] == 1 and both[9, 9, 9] == 1 and both[0, 0, 0] == 0
