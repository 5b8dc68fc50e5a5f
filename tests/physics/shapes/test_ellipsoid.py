"""Ellipsoids: no point of the surface is nearer, round ones are spheres."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as hs
from shape_cases import NUM, SHAPES, R, derivatives, evaluate, points

from rewax.physics import shapes as sdf


def on_sphere(num):
    """Nearly even directions, shape (num, 3)."""
    k = np.arange(num) + 0.5
    y, turn = 1.0 - 2.0 * k / num, np.pi * (1.0 + 5.0**0.5) * k
    r = np.sqrt(1.0 - y * y)
    return np.stack([r * np.cos(turn), y, r * np.sin(turn)], axis=1)


DIRECTIONS = on_sphere(4000)
semi_axis = hs.one_of(hs.floats(0.05, 1.0), hs.sampled_from([0.2, 0.7]))


@given(seed=hs.integers(0, 10_000), axes=hs.tuples(semi_axis, semi_axis, semi_axis), plane=hs.integers(0, 3))
def test_ellipsoid_has_no_nearer_point(x64, seed, axes, plane):
    """p - d n is on the surface, n is normal to it there, and none of 4000 surface points is nearer.

    Points with a coordinate of (nearly) zero, where one nearest point becomes two, and axes of equal length included.
    """
    axes, p = np.array(axes), points(seed)
    if plane < 3:
        p[::2, plane] *= 10.0 ** np.random.default_rng(seed).uniform(-20, -2, NUM // 2)
        p[::4, plane] = 0.0
    p[-1] = 0.0
    distance, normal = (np.asarray(a) for a in evaluate(sdf.Ellipsoid(semi_axes=axes), p))
    np.testing.assert_array_equal(distance < 0, np.linalg.norm(p / axes, axis=1) < 1)
    foot = p - distance[:, None] * normal
    np.testing.assert_allclose(np.linalg.norm(foot / axes, axis=1), 1.0, rtol=1e-10)
    gradient = foot / axes**2
    np.testing.assert_allclose(normal, gradient / np.linalg.norm(gradient, axis=1)[:, None], atol=1e-9)
    nearest = np.linalg.norm(p[:, None] - axes * DIRECTIONS, axis=2).min(axis=1)
    assert np.all(np.abs(distance) <= nearest + 1e-12)


def test_a_round_ellipsoid_is_a_sphere():
    """In float32."""
    p = jnp.asarray(points(3), jnp.float32)
    ball = sdf.Ellipsoid(semi_axes=jnp.full(3, R))
    for got, expected in zip(evaluate(ball, p), evaluate(SHAPES["sphere"], p), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-6)
    ones = jnp.ones(NUM, float), jnp.ones((NUM, 3), float)
    for leaf in jax.tree.leaves(derivatives((ball, p.at[0].set(0.0)), (ball, p), ones)):
        assert np.isfinite(leaf).all()
