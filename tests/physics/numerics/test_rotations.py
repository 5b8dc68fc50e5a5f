"""Turns of quaternions as vectors: against scipy, across the seam between series and formula, either sign."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rewax.physics.numerics.rotations import rotation_vector


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1.9e-4, 1.99e-4, 2.01e-4, 1e-3, 0.5, 3.0, 3.14])
def test_rotation_vectors_are_those_of_scipy(x64, angle):
    axes = np.random.default_rng(0).standard_normal((6, 3))
    turns = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    q = Rotation.from_rotvec(turns).as_quat()[:, [3, 0, 1, 2]]
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(rotation_vector(sign * q), turns, rtol=1e-11, atol=1e-24)
    by_q = jax.vmap(jax.jacobian(rotation_vector))(q)
    assert np.isfinite(by_q).all()
    if angle == 0.0:
        np.testing.assert_allclose(by_q[:, :, 1:], np.tile(2.0 * np.eye(3), (6, 1, 1)))
