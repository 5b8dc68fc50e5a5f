"""Boxes and half-spaces: against projections onto them."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as hs
from shape_cases import HALF, SHAPES, assert_nearest

from rewax.physics.numerics import components as cp
from rewax.physics.shapes import Box, fill


@given(seed=hs.integers(0, 10_000))
def test_distance_of_a_box_is_the_one_to_the_nearest_point(x64, seed):
    assert_nearest(SHAPES["box"], seed, lambda p: np.clip(p, -HALF, HALF), lambda p: (HALF - np.abs(p)).min(axis=1))


@given(seed=hs.integers(0, 10_000))
def test_distance_of_a_plane_is_the_height(x64, seed):
    assert_nearest(SHAPES["plane"], seed, lambda p: np.minimum(p, [np.inf, 0.0, np.inf]), lambda p: -p[:, 1])


def test_a_box_is_filled_from_face_to_face():
    """0.3 m in steps of about 0.11 m: three of 0.1 m, the first and last one half a step from a face."""
    x = fill(Box(half_size=(0.15, 0.05, 0.05)), 0.11)
    np.testing.assert_allclose(x, [[-0.1, 0, 0], [0, 0, 0], [0.1, 0, 0]], atol=1e-8)


def on_an_edge(noise: float):
    """Points on the edges x = z of a box, in a frame whose rounding decides on which side they lie."""
    half = np.array([0.05, 0.06, 0.05], np.float32)
    signs = np.array(list(itertools.product((-1, 1), (-1, 1))), np.float32)
    generator = np.random.default_rng(0)
    points = np.stack([signs[:, 0] * half[0], np.zeros(4, np.float32), signs[:, 1] * half[2]], axis=1)
    points = np.repeat(points, 50, axis=0)
    return Box(half_size=half), signs.repeat(50, axis=0), points + generator.uniform(-noise, noise, points.shape)


def test_rounding_does_not_decide_the_normal_on_an_edge():
    """It is the mean of both faces, and its derivative is zero, not the inverse of a rounding error."""
    box, signs, points = on_an_edge(3e-8)
    points = jnp.asarray(points, jnp.float32)

    def normal(p):
        return jnp.stack(box.distance(cp.split_vector(p))[1])

    expected = np.stack([signs[:, 0], np.zeros(len(signs)), signs[:, 1]], axis=1) / np.sqrt(2.0)
    np.testing.assert_allclose(jax.jit(jax.vmap(normal))(points), expected, rtol=1e-6)
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.jacrev(normal)))(points), np.zeros((len(points), 3, 3)))
    d = jax.vmap(lambda p: box.distance(cp.split_vector(p))[0])(points)
    np.testing.assert_allclose(d, 0.0, atol=1e-7)


def test_ten_micrometres_outside_an_edge_the_normal_is_exact():
    box, _, points = on_an_edge(0.0)
    shift = np.array([6e-6, 0.0, 8e-6], np.float32)
    d, n = jax.vmap(lambda p: box.distance(cp.split_vector(p)))(jnp.asarray(points + np.sign(points) * shift))
    np.testing.assert_allclose(d, 1e-5, rtol=0.01)
    np.testing.assert_allclose(np.abs(np.stack(n, 1)), np.tile([[0.6, 0.0, 0.8]], (len(points), 1)), atol=0.01)
