"""Turns of quaternions as vectors and as matrices: against scipy, across the seam between formulas, either sign."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rewax.physics.numerics.rotations import matrix_to_quaternion, quaternion_to_matrix, rotation_vector


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


def test_quaternions_of_matrices_turn_as_they_do(x64):
    """At all kinds of turns, half turns about each axis among them; derivatives are finite differences."""
    rng = np.random.default_rng(1)
    half_turns = np.pi * np.concatenate([np.eye(3), [[0.6, 0.8, 0.0]]])
    turns = np.concatenate([np.zeros((1, 3)), half_turns, 2.0 * rng.standard_normal((20, 3))])
    matrix = Rotation.from_rotvec(turns).as_matrix()
    q = np.asarray(jax.jit(matrix_to_quaternion)(matrix))
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-13)
    np.testing.assert_allclose(quaternion_to_matrix(q), matrix, atol=1e-13)
    move = rng.standard_normal(matrix.shape)
    forward = jax.jvp(matrix_to_quaternion, (matrix,), (move,))[1]
    ahead, behind = (matrix_to_quaternion(matrix + s * move) for s in (1e-6, -1e-6))
    np.testing.assert_allclose(forward, (ahead - behind) / 2e-6, atol=1e-7)
