"""Balls and capsules: against projections onto them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs
from shape_cases import SHAPES, H, R, assert_nearest

from rewax.physics.numerics import components as cp


def nearest_on_axis(name, p):
    half = H if name == "capsule" else 0.0
    return np.clip(p, [0, -half, 0], [0, half, 0])


@pytest.mark.parametrize("name", ["sphere", "capsule"])
@given(seed=hs.integers(0, 10_000))
def test_distance_is_the_one_to_the_nearest_point(x64, name, seed):
    def project(p):
        middle = nearest_on_axis(name, p)
        away = p - middle
        return middle + away * np.minimum(1.0, R / np.linalg.norm(away, axis=1))[:, None]

    assert_nearest(SHAPES[name], seed, project, lambda p: R - np.linalg.norm(p - nearest_on_axis(name, p), axis=1))


def test_a_capsule_without_length_is_a_ball(x64):
    ball, capsule = SHAPES["sphere"], SHAPES["capsule"].replace(half_length=0.0)
    np.testing.assert_allclose(capsule.volume(), ball.volume(), rtol=1e-12)
    for a, b in zip(capsule.inertia(3.0), ball.inertia(3.0), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_capsule_without_length_grows_at_both_ends(x64, side):
    def distance(half_length):
        return SHAPES["capsule"].replace(half_length=half_length).distance((0.3 * R, 2.0 * side * R, 0.1 * R))[0]

    none = jnp.asarray(0.0)
    expected = (distance(1e-7) - distance(0.0)) / 1e-7
    assert expected < -0.9
    np.testing.assert_allclose(jax.grad(distance)(none), expected, rtol=1e-6)
    np.testing.assert_allclose(jax.jvp(distance, (none,), (1.0,))[1], expected, rtol=1e-6)


@pytest.mark.parametrize("kind", ["sphere", "capsule", "cylinder", "cone"])
def test_rounding_does_not_decide_the_normal_on_the_axis(kind):
    """It is zero, and so is its derivative; a tenth of a millimetre away it points outwards."""
    shape, generator = SHAPES[kind], np.random.default_rng(0)
    noise = generator.uniform(-3e-8, 3e-8, (100, 3))

    def radial(p):
        n = shape.distance(cp.split_vector(p))[1]
        return jnp.stack([n[0], n[2]])

    on = jnp.asarray(noise, jnp.float32)
    np.testing.assert_array_equal(jax.vmap(radial)(on), np.zeros((100, 2)))
    np.testing.assert_array_equal(jax.vmap(jax.jacrev(radial))(on), np.zeros((100, 2, 3)))
    beside = on + jnp.array([6e-5, 0.0, 8e-5])
    outwards = np.tile([0.6, 0.8], (100, 1)) * (2 * H / np.hypot(R, 2 * H) if kind == "cone" else 1.0)
    np.testing.assert_allclose(jax.vmap(radial)(beside), outwards, atol=1e-3)
