"""Random points that keep their distance and leave no gap."""

import jax
import numpy as np
import pytest
from solids import FURTHER, SHAPES, distance

from rewax.physics import shapes as sdf
from rewax.physics.shapes.sampling import sample, sample_poisson_disk, volume


@pytest.mark.parametrize("name", SHAPES | {"cone": FURTHER["cone"]})
def test_poisson_disks_keep_their_distance_and_leave_no_gap(x64, name):
    shape, radius = (SHAPES | FURTHER)[name], 0.08
    x = sample_poisson_disk(jax.random.key(0), shape, radius)
    apart = np.linalg.norm(x[:, None] - x, axis=-1)
    assert apart[~np.eye(len(x), dtype=bool)].min() >= radius
    assert np.all(distance(shape, x) <= 1e-12)
    probes = sample(jax.random.key(1), shape, 4000)
    assert np.linalg.norm(probes[:, None] - x, axis=-1).min(axis=1).max() <= 2 * radius
    assert 0.6 < len(x) * radius**3 / float(volume(shape)) < 1.3  # near 0.72 for large shapes
    np.testing.assert_array_equal(x, sample_poisson_disk(jax.random.key(0), shape, radius))
    other = sample_poisson_disk(jax.random.key(1), shape, radius)
    assert other.shape != x.shape or np.any(other != x)


def test_a_plate_thinner_than_the_radius_is_covered(x64):
    """Where random darts seldom hit, they are pulled onto the shape."""
    plate, radius = sdf.Box(half_size=np.array([0.3, 1e-4, 0.3])), 0.1
    x = sample_poisson_disk(jax.random.key(0), plate, radius)
    probes = sample(jax.random.key(1), plate, 500)
    assert np.linalg.norm(probes[:, None] - x, axis=-1).min(axis=1).max() <= 2 * radius
    assert np.linalg.norm(x[:, None] - x + 9 * np.eye(len(x))[..., None], axis=-1).min() >= radius
