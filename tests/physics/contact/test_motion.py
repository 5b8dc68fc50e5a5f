"""Shapes among nodes: positions and velocities by hand, and their gradient's sums over nodes, in both forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.contact import motion
from rewax.physics.contact.motion import Motion, at_nodes, chord_motion, placed, velocity_at
from rewax.physics.numerics.pose import Pose


def nodes(key, *shape):
    return tuple(jax.random.normal(k, shape) for k in jax.random.split(jax.random.key(key), 3))


def test_places_are_in_the_shapes_frame_and_velocities_those_of_the_points(x64, rotations):
    before, after = jnp.asarray(rotations(0, 2))
    start = Pose(jnp.array([0.3, -0.1, 0.2]), before)
    end = Pose(start.position + jnp.array([0.01, 0.0, -0.02]), after)
    position = nodes(0, 5)
    local, velocity = at_nodes(placed(start, chord_motion(start, end, 1e-2)), position)
    points = jnp.stack(position, axis=-1)
    expected = (points - start.position) @ start.rotation  # R^T (x - p), row by row
    np.testing.assert_allclose(jnp.stack(local, axis=-1), expected, atol=1e-12)
    moved = expected @ end.rotation.T + end.position
    np.testing.assert_allclose(jnp.stack(velocity, axis=-1), (moved - points) / 1e-2, atol=1e-10)


def test_velocity_of_a_turning_body(x64):
    spin = jnp.array([[0.0, -2.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # two radians a second about z
    x, y, z = velocity_at(Motion(spin, jnp.array([0.0, 0.0, 0.5])), (jnp.ones(1), jnp.zeros(1), jnp.ones(1)))
    np.testing.assert_allclose([x[0], y[0], z[0]], [0.0, 2.0, 0.5])


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("num_outputs", [3, 6])
def test_both_forms_of_the_sums_over_nodes_agree(x64, batch, num_outputs):
    position = nodes(0, *batch, 7)
    cotangents = tuple(jax.random.normal(jax.random.key(i), (*batch, 7)) for i in range(num_outputs))
    products, sums = motion._AFFINE_TRANSPOSE.cpu, motion._AFFINE_TRANSPOSE.other
    matrix, offset = sums(None, position, cotangents)
    assert matrix.shape == (*batch, num_outputs, 3) and offset.shape == (*batch, num_outputs)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), (matrix, offset),
                 products(None, position, cotangents))  # fmt: skip
    # It is the transpose: <cotangents, f(linear)> = <transpose(cotangents), linear>.
    linear = jax.random.normal(jax.random.key(9), matrix.shape), jax.random.normal(jax.random.key(8), offset.shape)
    there = sum(jnp.vdot(c, v) for c, v in zip(cotangents, motion._affine(None, position, linear), strict=True))
    back = jnp.vdot(matrix, linear[0]) + jnp.vdot(offset, linear[1])
    np.testing.assert_allclose(there, back, rtol=1e-12)


def test_a_sum_in_float32_stays_float32():
    out = motion._sums_over_nodes(None, nodes(0, 4), nodes(1, 4))
    assert all(a.dtype == jnp.float32 for a in out)
