"""Poses of bodies: of one out of all, and of those that stay at the origin."""

import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.numerics.pose import Pose, body_pose, static_poses


def test_the_pose_of_one_body(rotations):
    poses = Pose(jnp.arange(9.0).reshape(3, 3), jnp.asarray(rotations(0, 3)))
    one = body_pose(poses, 1)
    np.testing.assert_array_equal(one.position, [3.0, 4.0, 5.0])
    np.testing.assert_array_equal(one.rotation, poses.rotation[1])


@pytest.mark.parametrize("num_bodies", [0, 1, 3])
def test_bodies_that_stay_are_unturned_at_the_origin_at_every_boundary(num_bodies):
    """Four substeps have five boundaries."""
    poses = static_poses(4, num_bodies, jnp.float32)
    np.testing.assert_array_equal(poses.position, np.zeros((5, num_bodies, 3)))
    np.testing.assert_array_equal(poses.rotation, np.tile(np.eye(3), (5, num_bodies, 1, 1)))
    assert {a.dtype for a in poses} == {np.dtype(np.float32)}


def test_the_precision_is_the_one_in_force(x64):
    assert {a.dtype for a in static_poses(1, 1)} == {np.dtype(np.float64)}
